"""The Ray launcher on a real cluster of two nodes, both on this machine, one of which is killed."""

import os
import threading
import time
import uuid

import psutil
import pytest
from test_sweeps import Silent, cells_of, scale_file

from sb3_ars.errors import ConfigError
from sb3_ars.experiments.cells import cell_state
from sb3_ars.experiments.launchers import RayLauncher
from sb3_ars.experiments.run_folder import find_runs, read_run

ray = pytest.importorskip("ray", reason='needs the extra "ray"')
pytestmark = [pytest.mark.services, pytest.mark.filterwarnings("ignore")]  # Ray's own code warns of much

CELL = "sb3_ars.experiments.cells"


@pytest.fixture
def cluster(monkeypatch):
    """A head and a second node, a core each; afterwards none of their processes is left."""
    from ray.cluster_utils import Cluster

    mark = uuid.uuid4().hex
    monkeypatch.setenv("SB3_ARS_TEST", mark)  # all processes of the cluster inherit it
    monkeypatch.setenv("PYTHONPATH", os.getcwd())
    size = {"num_cpus": 1, "object_store_memory": 80 * 2**20}
    cluster = Cluster(initialize_head=True, head_node_args={**size, "include_dashboard": False})
    try:
        cluster.second = cluster.add_node(**size)
        cluster.wait_for_nodes()
        yield cluster
    finally:
        ray.shutdown()
        cluster.shutdown()
        deadline = time.monotonic() + 20
        while (left := processes_with(mark)) and time.monotonic() < deadline:
            time.sleep(0.2)
        for process in left:
            process.kill()
        assert not left, left


def processes_with(mark):
    found = []
    for process in psutil.process_iter():
        try:
            if process.pid != os.getpid() and process.environ().get("SB3_ARS_TEST") == mark:
                found.append(process)
        except psutil.Error:
            continue
    return found


def cells_on(node):
    """Processes of cells on a node."""
    (raylet,) = node.all_processes["raylet"]
    below = psutil.Process(raylet.process.pid).children(recursive=True)
    return [process for process in below if CELL in " ".join(process.cmdline())]


class Noting(Silent):
    def __init__(self):
        self.names, self.n_ready = [], 0

    def ready(self):
        self.n_ready += 1

    def started(self, cell):
        raise AssertionError("a cell that only waits does not look started")

    def ended(self, outcome):
        self.names.append(outcome.cell.name)


def test_every_cell_is_finished_once_though_a_node_is_killed(cluster, tmp_path):
    output, monitor = tmp_path / "out", Noting()
    cells = cells_of(scale_file(tmp_path), "table4", seeds=2)
    assert len(cells) == 6
    killed = []

    def kill():
        while not (found := cells_on(cluster.second)):
            time.sleep(0.02)
        killed.extend(found)
        cluster.remove_node(cluster.second, allow_graceful=False)

    thread = threading.Thread(target=kill)
    thread.start()
    outcomes = RayLauncher(cluster.address, retries=3).run(cells, output, monitor)
    thread.join()
    assert killed and not any(process.is_running() for process in killed)
    assert [outcome.status for outcome in outcomes] == ["finished"] * 6, outcomes
    assert sorted(monitor.names) == sorted(cell.name for cell in cells)  # each of them once
    assert monitor.n_ready == 1
    runs = [read_run(folder) for folder in find_runs(output)]
    assert {(run.name, run.seed) for run in runs} == {(cell.preset, cell.seed) for cell in cells}
    assert all(run.result["timesteps"] == 400 for run in runs)
    assert all(cell_state(cell, output) == "finished" for cell in cells)
    left = {path.name for path in output.rglob("*") if path.suffix in (".running", ".failed")}
    assert not left


def test_a_cell_that_fails_is_reported_and_no_room_is_an_error(cluster, tmp_path):
    # SMT's decisions are farther apart than this run is long
    cells = cells_of(scale_file(tmp_path), "table1", only=["mt10-smt"])
    (outcome,) = RayLauncher(cluster.address).run(cells, tmp_path, Silent())
    assert outcome.status == "failed" and outcome.error.startswith("ConfigError: interval=15000")
    assert "interval=15000" in (tmp_path / "tiny" / "mt10-smt" / "seed0.failed" / "log.txt").read_text()
    with pytest.raises(
        ConfigError, match=r"No node of the Ray cluster has --cpus-per-cell=2 .* have 1 CPUs and 0 GPUs"
    ):
        RayLauncher(cluster.address, cpus_per_cell=2).run(cells, tmp_path, Silent())


def test_what_is_finished_when_a_sweep_is_interrupted_is_gathered(cluster, tmp_path, monkeypatch):
    wait, seen = ray.wait, []

    def interrupted(references, **options):
        """Ctrl-C after a cell came to its end, before anybody looked."""
        if not seen:
            seen.append(wait(references, num_returns=1, timeout=120))
            raise KeyboardInterrupt
        return wait(references, **options)

    monkeypatch.setattr(ray, "wait", interrupted)
    cells = cells_of(scale_file(tmp_path), "table4", seeds=2)
    with pytest.raises(KeyboardInterrupt):
        RayLauncher(cluster.address).run(cells, tmp_path, Silent())
    assert "finished" in [cell_state(cell, tmp_path) for cell in cells]
    assert not list(tmp_path.rglob("*.running"))


def test_no_cluster_is_an_error_that_names_the_remedy(tmp_path):
    cells, monitor = cells_of(scale_file(tmp_path), "table4"), Noting()
    with pytest.raises(ConfigError, match=r"There is no Ray cluster at --ray-address=.*'ray start --head'"):
        RayLauncher("127.0.0.1:1").run(cells, tmp_path, monitor)
    assert monitor.n_ready == 0  # and so nothing was announced
    assert not list(tmp_path.rglob("*.running"))
