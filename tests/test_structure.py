"""The package's structure and documents: who imports whom, what is exported, what the README promises."""

import ast
import fnmatch
import importlib
import inspect
import json
import subprocess
import sys
from pathlib import Path

import pytest

import sb3_ars
from benchmarks.toy_methods import summary

ROOT = Path(sb3_ars.__file__).parent
LAYER = {  # each may import those before it, and its own
    "errors": 0, "files": 0, "machine": 0, "plain": 0, "profiling": 0, "checkpoints": 1, "core": 1,
    "nets": 2, "metrics": 2, "versions": 2, "config": 2, "envs": 2, "task_id": 2,
    "buffers": 3, "policies": 3, "policy_description": 3,
    "callbacks.ars": 4,  # beneath the algorithms, whose learn() installs it
    "algorithms": 5, "evaluation": 5, "policy_file": 5, "callbacks": 6, "experiments": 7, "doctor": 7, "tuning": 8,
    "video": 7, "integrations": 8, "commands": 9, "cli": 10, "": 11,
}  # fmt: skip


def layer_of(module):
    for name in (module, module.split(".")[0]):
        if name in LAYER:
            return LAYER[name]
    raise AssertionError(f"give the new module {module} a layer")


def imports_of(path):
    """Names inside the package a module imports at run time, wherever the import stands."""
    tree = ast.parse(path.read_text())
    typing_only = {
        id(node)
        for block in ast.walk(tree)
        if isinstance(block, ast.If) and "TYPE_CHECKING" in ast.dump(block.test)
        for node in ast.walk(block)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and id(node) not in typing_only:
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def modules():
    for path in sorted(ROOT.rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        yield name.removesuffix("__init__").removesuffix("."), path


def test_imports_go_one_way():
    for name, path in modules():
        for imported in imports_of(path):
            if imported.startswith("sb3_ars."):
                inner = imported.removeprefix("sb3_ars.")
                assert layer_of(inner) <= layer_of(name), f"{name} imports {inner}"


@pytest.mark.parametrize("package", ["core", "nets"])
def test_the_method_knows_no_sb3_and_no_environments(package):
    for path in (ROOT / package).glob("*.py"):
        for imported in imports_of(path):
            assert imported.split(".")[0] not in (
                "stable_baselines3",
                "sb3_contrib",
                "gymnasium",
                "metaworld",
            ), path


def test_every_exported_name_exists_and_has_a_docstring():
    for name in sb3_ars.__all__:
        assert getattr(sb3_ars, name).__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'ARS'"):
        sb3_ars.ARS  # noqa: B018  # sb3-contrib's ARS is Augmented Random Search; ours is never called so


def test_every_module_says_what_it_is_for():
    for name, path in modules():
        assert ast.get_docstring(ast.parse(path.read_text())), name or "sb3_ars"


def test_importing_the_package_or_its_envs_loads_no_torch():
    script = "import sys, sb3_ars, sb3_ars.envs.workers, sb3_ars.envs.toy; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_the_readmes_table_names_real_presets_and_commands():
    from sb3_ars.experiments import preset_names

    readme = (ROOT.parent / "README.md").read_text()
    table = readme.split("| presets | what they train |\n")[1].split("\n\n")[0]
    patterns = [name for row in table.splitlines()[1:] for name in row.split("|")[1].split("`")[1::2]]
    assert len(patterns) > 10
    for pattern in patterns:
        assert fnmatch.filter(preset_names(), pattern), pattern
    for name in preset_names():
        assert any(fnmatch.fnmatch(name, pattern) for pattern in patterns), name
    for target in ("make demo", "make test"):
        assert target in readme


def test_the_version_is_the_changelogs():
    changelog = (ROOT.parent / "CHANGELOG.md").read_text()
    assert f"## {importlib.import_module('sb3_ars').__version__}" in changelog


def test_every_option_and_logged_number_is_documented():
    from sb3_ars import ARSSAC, ARSConfig, make_toy_env
    from sb3_ars.config import ExecutionConfig
    from sb3_ars.policies import ARSSACPolicy

    options = (ROOT.parent / "docs" / "options.md").read_text()
    for name in [*ARSConfig.__dataclass_fields__, *ExecutionConfig.__dataclass_fields__]:
        assert f"`{name}`" in options, name
    for name in list(inspect.signature(ARSSACPolicy.__init__).parameters)[4:-1]:
        assert f"`{name}`" in options, name
    model = ARSSAC(
        "MlpPolicy", make_toy_env(seed=0), batch_size=8, n_reset=0, policy_kwargs={"net_arch": [8]}
    )
    model.learn(320, log_interval=None)
    written = {}
    model.logger.record = lambda key, value, exclude=None: written.setdefault(key, value)
    model.dump_logs()
    sb3s = {
        "rollout/ep_rew_mean",
        "rollout/ep_len_mean",
        "rollout/success_rate",
        *(k for k in written if k[:5] == "time/"),
    }
    sb3s |= {
        f"train/{key}" for key in ("n_updates", "ent_coef", "actor_loss", "critic_loss", "ent_coef_loss")
    }
    ours = {
        key.replace("point-west", "<task>") for key in written if "point-" not in key or "point-west" in key
    } - sb3s
    assert len(ours) == 7
    for key in ours:
        assert f"`{key}`" in options, key


def measured_rows():
    """The README's rows of measured numbers, from the files the benchmarks wrote."""
    results = ROOT.parent / "benchmarks" / "results"
    toy = json.loads((results / "toy_methods.json").read_text())["runs"]
    for arm, label in (("ars", "`ars`"), ("ars-bf16", 'the same with `precision="bf16"`')):
        found = summary(toy[arm])
        label = f"toy tasks, {found['seeds']} seeds, {label}" if arm == "ars" else label
        yield f"| {label} | mean success {found['mean']:.2f}, lowest of any task and seed {found['lowest']:.2f} |"
    quiet = max(max(run["success"][2:]) for run in toy["sac"].values())
    yield f"| the same without scaling and resets | highest success of a quiet task in any seed: {quiet:.2f} |"
    for run in json.loads((results / "demo.json").read_text())["runs"]:
        minutes = run["training_seconds"] / 60
        yield f"| `make demo`, seed {run['seed']} | mean success {run['mean_success']:.2f} in {minutes:.1f} minutes |"
    gpu = json.loads((results / "gpu_mt10.json").read_text())
    success = gpu["curve"][-1]["mean_success"]
    steps, minutes = gpu["curve"][-1]["timesteps"] / 1e6, gpu["curve"][-1]["seconds"] / 60
    label = f"`mt10-ars-ln` on an H100, {steps:.0f} of its 20 million steps, one seed"
    yield f"| {label} | mean success {success:.2f} after {minutes:.1f} minutes, the first reset not reached yet |"


def test_the_readmes_numbers_are_the_benchmarks():
    readme = (ROOT.parent / "README.md").read_text()
    for row in measured_rows():
        assert row in readme, row
