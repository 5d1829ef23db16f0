"""Policies to and from the Hugging Face hub, with a card that says what was measured; needs ``sb3-ars[hub]``.

The zip beside the policy's file is SB3's, under the name ``policy.zip``, so ``huggingface_sb3.load_from_hub`` fetches
it as well.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any, Literal, overload

from sb3_ars.algorithms.multi_task import MultiTaskOffPolicyAlgorithm
from sb3_ars.errors import ConfigError
from sb3_ars.experiments.catalogue import preset_names
from sb3_ars.experiments.config import load_config, load_preset
from sb3_ars.experiments.run_folder import RESULT, Run, read_run
from sb3_ars.experiments.runner import load_model
from sb3_ars.policy_file import LoadedPolicy, load_policy

try:
    import huggingface_hub
    from huggingface_hub import EvalResult, HfApi, ModelCardData
except ImportError as error:
    raise ConfigError(f'The hub needs one more package ({error}): pip install "sb3-ars[hub]"') from error

__all__ = ["load_from_hub", "model_card", "package_run", "push_run"]

_FILES = (
    "policy.safetensors",
    "policy.zip",
    "config.yaml",
    "versions.json",
    RESULT,
    "evaluation.csv",
    "progress.csv",
    "training.png",
)


def push_run(
    folder: Path,
    repo_id: str,
    token: str | None = None,
    private: bool = False,
    commit_message: str = "Upload a run of sb3_ars",
) -> str:
    """Upload a finished run's policy, configuration, results, videos and model card; return the repository's address.

    :param folder: of the run
    :param repo_id: "user/name"; it is made if it does not exist
    :param token: of the hub; ``None`` is the one of ``hf auth login``
    :param private: whether a new repository is
    :param commit_message: of the upload
    :raises ConfigError: if the folder holds no finished run
    """
    with tempfile.TemporaryDirectory() as temporary:
        packed = package_run(folder, Path(temporary) / "run", repo_id)
        api = HfApi(token=token)
        address = api.create_repo(repo_id, private=private, exist_ok=True)
        api.upload_folder(repo_id=repo_id, folder_path=packed, commit_message=commit_message)
    return str(address)


def package_run(folder: Path, output: Path, repo_id: str) -> Path:
    """Write what :func:`push_run` uploads into a new folder, and return it.

    :param folder: of the run
    :param output: folder to make
    :param repo_id: "user/name", for the card
    :raises ConfigError: if ``folder`` holds no finished run, or ``output`` exists
    """
    run = read_run(folder)
    try:
        output.mkdir(parents=True)
    except OSError as error:
        raise ConfigError(f"{output} cannot be made ({error.strerror}); choose a new folder.") from error
    for name in _FILES:
        if (folder / name).is_file():
            shutil.copyfile(folder / name, output / name)
    if (folder / "videos").is_dir():
        shutil.copytree(folder / "videos", output / "videos")
    (output / "README.md").write_text(model_card(run, repo_id), encoding="utf-8")
    return output


@overload
def load_from_hub(
    repo_id: str, trust: Literal[False] = ..., revision: str | None = ..., device: str = ...
) -> LoadedPolicy: ...


@overload
def load_from_hub(
    repo_id: str, trust: Literal[True], revision: str | None = ..., device: str = ...
) -> MultiTaskOffPolicyAlgorithm: ...


def load_from_hub(
    repo_id: str, trust: bool = False, revision: str | None = None, device: str = "auto"
) -> LoadedPolicy | MultiTaskOffPolicyAlgorithm:
    """Download a policy that :func:`push_run` uploaded, and load it; nothing that was uploaded is executed.

    With ``trust`` it is the model to train on, from SB3's file, which holds pickled Python and can run any code when it
    is loaded: only for people you trust.

    :param repo_id: "user/name"
    :param trust: that you do
    :param revision: commit, tag or branch; a commit cannot be replaced behind your back
    :param device: SB3's
    :raises ConfigError: if the repository holds no run of ours, or its policy is damaged
    """
    if trust:
        config, model = (_download(repo_id, name, revision) for name in ("config.yaml", "policy.zip"))
        return load_model(model, load_config(config), device)
    return load_policy(_download(repo_id, "policy.safetensors", revision), device)


def _download(repo_id: str, name: str, revision: str | None) -> Path:
    try:
        return Path(huggingface_hub.hf_hub_download(repo_id, name, revision=revision))
    except (OSError, ValueError) as error:  # the hub's errors are kinds of these
        older = (
            ""
            if name != "policy.safetensors"
            else " A run uploaded by another version may have policy.zip alone, which "
            "can run any code when it is loaded: trust=True loads it, if you trust its author."
        )
        raise ConfigError(
            f"{repo_id} cannot be downloaded as a run of sb3_ars, for {name} cannot be had: {error}.{older}"
        ) from error


def model_card(run: Run, repo_id: str) -> str:
    """Return the card, Markdown with metadata: what was trained, for how long, and how it was measured.

    :param run: finished
    :param repo_id: "user/name"
    """
    config, tasks = run.config, run.config.env.tasks
    algorithm = config.algorithm.algorithm
    named = tasks if isinstance(tasks, str) else ", ".join(tasks)
    benchmark = named if config.env.is_toy else f"Meta-World {named}"
    metadata = ModelCardData(
        library_name="stable-baselines3",
        tags=[
            "sb3-ars",
            "stable-baselines3",
            "reinforcement-learning",
            "deep-reinforcement-learning",
            "multi-task",
        ],
        model_name=f"{algorithm} {run.name}",
        eval_results=[
            EvalResult(
                task_type="reinforcement-learning",
                task_name=run.result.get("protocol", "evaluation"),
                dataset_type="meta-world" if not config.env.is_toy else "toy",
                dataset_name=benchmark,
                metric_type="mean_success_rate",
                metric_name="mean success rate over tasks",
                metric_value=run.result["mean_success"],
            )
        ],
    )
    return _CARD.format(
        metadata=metadata.to_yaml(),
        algorithm=algorithm,
        benchmark=benchmark,
        name=run.name,
        seed=run.seed,
        steps=f"{run.result['timesteps']:,}",
        planned=f"{config.algorithm.total_timesteps:,}",
        preset_length=_preset_length(run),
        ended=" (interrupted by hand)" if run.result.get("interrupted") else "",
        scale=config.scale
        if config.scale == "full"
        else f"`{config.scale}`, not the size of the paper's runs",
        widths=list(config.policy.net_arch),
        protocol=run.result.get("protocol", "not recorded"),
        mean=_percent(run.result["mean_success"]),
        rows="\n".join(_row(name, values) for name, values in run.result["tasks"].items()),
        versions=", ".join(f"{k} {v}" for k, v in run.versions.get("packages", {}).items() if v is not None),
        python=run.versions.get("python", "unknown"),
        repo_id=repo_id,
    )


def _preset_length(run: Run) -> str:
    if run.name not in preset_names():
        return ""
    steps = load_preset(run.name).algorithm.total_timesteps
    shortened = steps != run.config.algorithm.total_timesteps
    return f"; the preset's own length is {steps:,}" if shortened else ""


def _row(name: str, values: dict[str, Any]) -> str:
    success, sampled = _percent(values["success"]), _percent(values["success_sampled"])
    return f"| {name} | {success} | {sampled} | {values['return']:,.1f} | {values['c']:.3g} |"


def _percent(rate: float | None) -> str:
    return "not reported" if rate is None else f"{rate:.1%}"


_CARD = """---
{metadata}
---

# {algorithm} on {benchmark}

One policy for several tasks, trained with Adaptive Reward Scaling (not Augmented Random Search) by
`sb3_ars`, a kit for Stable-Baselines3.

- preset `{name}`, seed {seed}: one seed, so take the numbers as one sample
- {steps} environment steps of {planned} planned, summed over tasks{ended}{preset_length}
- scale of the run: {scale}; hidden layers {widths}
- measured under {protocol}: mean success {mean}

| task | success | success, sampled actions | return | c_i |
|---|---|---|---|---|
{rows}

Success: in at least one step of an episode. c_i: the reward scale at the end of training.

Trained with python {python}, {versions}. `config.yaml` holds every option, `result.json` every result.

## Use

```python
from sb3_ars.integrations.hub import load_from_hub

policy = load_from_hub("{repo_id}")  # policy.predict(observation)
```

This loads `policy.safetensors`, numbers and text that execute nothing. `policy.zip` is the model to train on, which
`load_from_hub("{repo_id}", trust=True)` loads: it holds pickled Python, as all files of Stable-Baselines3 do, and can
run any code when it is loaded, so look at who uploaded it first.
"""
