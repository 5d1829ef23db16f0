"""The documents: the site builds, every command and every Python example in them runs, with smaller numbers."""

import configparser
import functools
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import zlib
from importlib import metadata, resources
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml

import sb3_ars
from sb3_ars import RunCheckpoint, cli
from sb3_ars.algorithms.multi_task import MultiTaskOffPolicyAlgorithm
from sb3_ars.envs.rendering import find_gl_backend
from sb3_ars.envs.toy import PointTask, make_toy_env
from sb3_ars.errors import ConfigError

ROOT = Path(sb3_ars.__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
LANGUAGES = {"sh": "sh", "bash": "sh", "python": "python", "yaml": "yaml", "text": "text"}
FENCE = re.compile(r"^( *)```([\w{}-]*)[^\n]*\n(.*?)^ *```$", flags=re.MULTILINE | re.DOTALL)


def name_of(page):
    return str(page.relative_to(ROOT))


def blocks(page, language):
    """The page's code blocks of a language; those within a list are indented."""
    for indent, kind, code in FENCE.findall(page.read_text()):
        if LANGUAGES.get(kind) == language:
            yield re.sub(rf"^{indent}", "", code, flags=re.MULTILINE)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_code_block_says_its_language(page):
    for _, kind, code in FENCE.findall(page.read_text()):
        assert kind in LANGUAGES or kind.startswith("{"), code


# ---------------------------------------------------------------------- what examples need to be there, and to be short

STEPS = 200
RUN = (
    f"--algorithm.total-timesteps {STEPS} --algorithm.batch-size 4 --algorithm.buffer-size 500 "
    "--algorithm.learning-starts 20 --ars.updates-after-reset 1 --policy.net-arch 16 16 --evaluation.n-episodes 1 "
)
"""Options that make a run of any preset short."""
REAL = "--env.tasks reach push --env.n-workers 0 --env.max-episode-steps 10 "
"""Two of Meta-World's tasks instead of ten or fifty, in this process."""


def tiny_scale():
    """A scale as small as a sweep or a study can be."""
    toy = yaml.safe_load((resources.files("sb3_ars.experiments") / "scales/toy.yaml").read_text())
    toy["options"]["algorithm"]["batch_size"] = 4
    toy["options"]["evaluation"]["n_episodes"] = 1
    toy["at_most"]["hidden_width"] = 8
    return toy | {
        "steps_per_task": 100,
        "random_steps": 5,
        "updates_after_reset": 1,
        "evaluations": 2,
        "log_episodes": 1,
    }


def train_runs_that_are_named(text):
    """Train the runs, such as runs/toy-seed0, that an example takes for granted."""
    named = re.findall(r"runs/([\w-]+?)-seed(\d+)", text)
    if re.search(r"report runs|Path\(\"runs\"\)", text) and not Path("runs").exists():
        named.append(("toy", "0"))
    for preset, seed in named:
        if not Path(f"runs/{preset}-seed{seed}").exists():
            assert cli.main(shlex.split(how(f"sb3-ars train {preset} --seed {seed}")[1])[1:]) == 0


def leave_interrupted(folder):
    """Put a run that Ctrl-C has ended early where an example resumes one."""
    preset, seed = re.fullmatch(r"runs/([\w-]+?)-seed(\d+)", folder).groups()
    shutil.rmtree(folder, ignore_errors=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunCheckpoint, "_on_step", lambda self: self.num_timesteps < 100 or _interrupt())
        assert cli.main(shlex.split(how(f"sb3-ars train {preset} --seed {seed}")[1])[1:]) == 0


def _interrupt():
    signal.raise_signal(signal.SIGINT)
    return True


def version(package):
    """The installed version of a package, empty where there is none."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def what_is_missing(text):
    """Why an example cannot run on this machine, or None."""
    if re.search(r"sb3-ars video|\brecord\(", text):
        try:
            find_gl_backend()
        except ConfigError as error:
            return str(error)
    wanted = re.findall(r"^(?:import|from) (\w+)", text, flags=re.MULTILINE)
    wanted += [
        module for start, module in {"jupyter ": "nbclient", "ray ": "ray"}.items() if text.startswith(start)
    ]
    wanted += ["rl_zoo3"] if "rl_zoo" in text else []
    missing = [module for module in wanted if find_spec(module) is None]
    if missing:
        return f"{', '.join(missing)} not installed"
    # SB3's recorder; RL Zoo's requirements can bring an older one that does not work
    return "moviepy 2 not installed" if "VecVideoRecorder" in text and version("moviepy") < "2" else None


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder to work in, with a tiny scale; algorithms take few rows, and few updates after a reset."""
    init, few = MultiTaskOffPolicyAlgorithm.__init__, {"batch_size": 4, "updates_after_reset": 2}
    monkeypatch.setattr(
        MultiTaskOffPolicyAlgorithm,
        "__init__",
        functools.wraps(init)(lambda self, *args, **given: init(self, *args, **{**given, **few})),
    )
    monkeypatch.chdir(tmp_path)
    Path("tiny.yaml").write_text(yaml.safe_dump(tiny_scale()))
    # for the processes that examples start
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("SB3_ARS_SHORT", "1")
    monkeypatch.setenv("WANDB_MODE", "disabled")
    return tmp_path


# ---------------------------------------------------------------------- commands

ZOO = "--seed 1 -params batch_size:8 updates_after_reset:2"
"""Options that make a run of RL Zoo short."""

HOW = [  # (the start of a command as a regular expression, what to append so that it takes a moment); the first counts
    (r"sb3-ars (list|doctor)", ""),
    (r"sb3-ars train --resume", ""),
    (r"sb3-ars train toy", f"{RUN} --ars.param-resets 100"),
    (r"sb3-ars train demo", f"{RUN} {REAL} --ars.param-resets 100"),
    (r"sb3-ars train mt\d+-smt", f"{RUN} {REAL} --schedule.pool-size 1 --schedule.interval 40"),
    (r"sb3-ars train", RUN + REAL),
    (r"sb3-ars evaluate", "--n-episodes 1"),
    (r"sb3-ars video", "--size 64"),
    (r"sb3-ars bench$", ""),
    (r"sb3-ars bench", "--scale tiny.yaml --seeds 1 --only mt10-ars"),
    (r"sb3-ars report", ""),
    # the server is another test's business
    (
        r"sb3-ars tune .*--storage postgresql",
        "--n-trials 1 --seeds 1 --scale tiny.yaml --storage a.log --study a",
    ),
    (r"sb3-ars tune", "--n-trials 1 --seeds 1 --evaluations 1 --scale tiny.yaml"),
    (r"python -m sb3_ars.integrations.rl_zoo train", f"-n 400 --eval-freq 200 --eval-episodes 4 {ZOO}"),
    (
        r"python -m sb3_ars.integrations.rl_zoo tune",
        f"-n 1200 --n-trials 2 --eval-episodes 4 --no-optim-plots {ZOO}",
    ),
    (r"python -m sb3_ars.integrations.rl_zoo enjoy", "-n 20"),
    (r"python -m benchmarks.run_all", "--output results"),
    (r"jupyter execute", ""),
    (r"pytest", "-n 0 -p no:cacheprovider tests/test_metrics.py"),
    (r"make [\w-]+$", ""),
    (r"pip install", ""),
]


def commands(page):
    """The page's shell commands in order, without their comments; a line may end in a backslash and go on."""
    for block in blocks(page, "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words:
                yield shlex.join(words)


def how(command):
    """The place of a command in the table, and the command made short."""
    for index, (pattern, appended) in enumerate(HOW):
        if re.match(pattern, command):
            return index, f"{command} {appended}".strip()
    raise AssertionError(f"say in tests/test_docs.py how {command!r} is run in a moment")


def of_make(command):
    """The commands a target of the Makefile would run, those that set up its environment included."""
    if not command.startswith("make "):
        return []
    make = ["make", "-nB", *command.split()[1:]]
    done = subprocess.run(make, cwd=ROOT, capture_output=True, text=True, check=True)
    lines = done.stdout.replace("\\\n", " ").splitlines()
    inner = [line.removeprefix(".venv/bin/") for line in lines if line.startswith(".venv/bin/")]
    assert inner, done.stdout
    return [shlex.join(shlex.split(line)) for line in inner]


def test_every_line_of_the_table_is_for_a_command_that_a_document_has():
    of_pages = [command for page in PAGES for command in commands(page)]
    used = {how(inner)[0] for command in of_pages for inner in (command, *of_make(command))}
    assert [HOW[index] for index in sorted(set(range(len(HOW))) - used)] == []


def run(command, monkeypatch):
    """Run a command as the table says and return its exit status."""
    program, *arguments = shlex.split(how(command)[1])
    if program == "make":
        return max(run(inner, monkeypatch) for inner in of_make(command))
    if program == "sb3-ars":
        return cli.main(arguments)
    if program == "pip":
        return check_pip_install(arguments)
    if program == "jupyter":
        shutil.copytree(ROOT / "notebooks", "notebooks")
        jupyter = Path(sys.executable).with_name("jupyter")
        return subprocess.run([jupyter, *arguments], check=False).returncode
    if "benchmarks.run_all" in arguments:
        return run_benchmarks(arguments, monkeypatch)
    module = [] if program == "python" else ["-m", program]
    where = ROOT if program == "pytest" else None
    return subprocess.run([sys.executable, *module, *arguments], cwd=where, check=False).returncode


def check_pip_install(arguments):
    """Installing is not a test's business; that what is named exists is."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    for name in re.findall(r"[\w.-]+\.txt", " ".join(arguments)):
        assert (ROOT / name).is_file(), name
    for extras in re.findall(r"(?:sb3-ars|\.)\[([\w,-]+)\]", " ".join(arguments)):
        for extra in extras.split(","):
            assert extra in setup["options.extras_require"], extra
    return 0


def run_benchmarks(arguments, monkeypatch):
    """Run the benchmarks' command with what was measured once in place of measuring, which takes long."""
    from benchmarks import report, run_all

    measured = report.read_results()
    stored = {name: lambda name=name: measured[name] for name in run_all.BENCHMARKS}
    monkeypatch.setattr(run_all, "BENCHMARKS", stored)
    monkeypatch.setattr(sys, "argv", arguments[1:])
    return run_all.main()


@pytest.mark.metaworld
@pytest.mark.filterwarnings("ignore:The adapters of lora are due")  # so few steps teach no task
@pytest.mark.parametrize("page", [page for page in PAGES if any(commands(page))], ids=name_of)
def test_the_commands_of_a_page_run_one_after_another(page, folder, monkeypatch, capfd):
    left_out = []
    for command in commands(page):
        reason = what_is_missing(command)
        if reason is not None:
            left_out.append(f"{command}: {reason}")
            continue
        if "--resume" in command:
            leave_interrupted(command.split()[-1])
        train_runs_that_are_named(command)
        capfd.readouterr()
        status = run(command, monkeypatch)
        printed = "".join(capfd.readouterr())
        assert status == 0, f"{command}\n{printed}"
    if left_out:
        pytest.skip("; ".join(left_out))


# ---------------------------------------------------------------------- Python examples

SMALLER = [
    (r"learn\([\d_]+", f"learn({STEPS}"),
    (r", progress_bar=True", ""),
    (r"param_resets=\[[\d_]+\]", "param_resets=[100]"),
    (r"n_seeds=2", "n_seeds=1"),
    (r"n_trials=10", "n_trials=1"),
    (r"every=1000", "every=60"),
    (r'scale="toy"', 'scale="tiny.yaml"'),
    # what a run this short cannot wait for
    (r'"rank": 8', '"rank": 8, "min_success": 0'),
    (r"pool_size=3", "pool_size=3, interval=40"),
]


def test_every_replacement_in_the_examples_is_needed():
    code = "".join(block for page in PAGES for block in blocks(page, "python"))
    assert [pattern for pattern, _ in SMALLER if not re.search(pattern, code)] == []


@pytest.fixture
def small(monkeypatch):
    """The toy tasks in Meta-World's place, a folder in the hub's."""
    toy = lambda tasks, **options: make_toy_env(**options)  # noqa: E731
    monkeypatch.setattr(sb3_ars, "make_metaworld_env", toy, raising=False)
    if find_spec("huggingface_hub"):
        hub = pytest.importorskip("huggingface_hub")
        monkeypatch.setattr(hub.HfApi, "create_repo", lambda self, repo_id, **_: f"hub/{repo_id}")
        monkeypatch.setattr(
            hub.HfApi,
            "upload_folder",
            lambda self, repo_id, folder_path, **_: shutil.copytree(folder_path, f"hub/{repo_id}"),
        )
        monkeypatch.setattr(hub, "hf_hub_download", lambda repo_id, name, **_: f"hub/{repo_id}/{name}")


@pytest.mark.metaworld
@pytest.mark.parametrize("page", [page for page in PAGES if any(blocks(page, "python"))], ids=name_of)
def test_the_python_examples_of_a_page_run_one_after_another(page, folder, small, monkeypatch, capsys):
    namespace = {"make_left_env": PointTask, "make_right_env": PointTask}
    left_out = []
    for code in blocks(page, "python"):
        reason = what_is_missing(code)
        if reason is not None:
            left_out.append(reason)
            continue
        train_runs_that_are_named(code)
        for pattern, replacement in SMALLER:
            code = re.sub(pattern, replacement, code)
        exec(compile(code, str(page), "exec"), namespace)
        if "model.learn(" in code:
            assert namespace["model"].num_timesteps >= STEPS and namespace["model"]._n_updates > 10
    if left_out:
        pytest.skip("; ".join(left_out))


# ---------------------------------------------------------------------- the site


def test_the_site_builds_without_warnings_is_complete_and_has_no_dead_link(tmp_path):
    """One test, because the tests' processes would each build a site of their own."""
    for package in ("sphinx", "myst_parser", "furo"):
        pytest.importorskip(package, reason=f'{package} is missing: pip install "sb3-ars[docs]"')
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    done = subprocess.run(
        [*command, "-d", str(tmp_path / "doctrees"), str(ROOT / "docs"), str(tmp_path / "html")],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    check_site(tmp_path / "html")


def check_site(site):
    for page in PAGES[1:]:
        html = site / page.relative_to(ROOT / "docs").with_suffix(".html")
        assert html.is_file() and "<h1>" in html.read_text(), page
    inventory = (site / "objects.inv").read_bytes().split(b"\n", 4)[4]
    documented = {line.split()[0] for line in zlib.decompress(inventory).decode().splitlines()}
    assert [name for name in sb3_ars.__all__ if f"sb3_ars.{name}" not in documented] == []
    links = [
        (html, link)
        for html in site.rglob("*.html")
        for link in re.findall(r'(?:href|src)="([^"#:?]+)[#?"]', html.read_text())
    ]
    assert len(links) > 100
    assert [(html.name, link) for html, link in links if not (html.parent / link).exists()] == []
