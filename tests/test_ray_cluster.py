"""Calls on a Ray cluster: repeated where a process dies, cores of each, and clusters that are not there."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
from ray_runs import needs_ray, silent

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.system.ray_cluster import Cluster


class FakeRay:
    """Ray in this process: calls happen in `wait`, and the processes of the calls `dies` die."""

    class RayError(Exception):
        """An error of the cluster."""

    class RayTaskError(RayError):
        """An error of a function."""

    exceptions = SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)

    def __init__(self, cores: list[int], dies: list[int] = ()) -> None:
        self.cores, self.dies, self.calls = cores, list(dies), 0

    def nodes(self):
        return [{"Alive": True, "Resources": {"CPU": float(cores)}} for cores in self.cores]

    def cluster_resources(self):
        return {}

    def remote(self, **options):
        return lambda function: SimpleNamespace(remote=lambda *arguments: (self._count(), function, arguments))

    def _count(self) -> int:
        self.calls += 1
        return self.calls

    def wait(self, references, num_returns, timeout):
        return references[:1], references[1:]

    def get(self, reference):
        number, function, arguments = reference
        if number in self.dies:
            raise self.RayError("\nThe worker died. Perhaps.\nMore about it.")
        try:
            return function(*arguments)
        except Exception as error:
            raised = self.RayTaskError("a traceback")
            raised.cause = error
            raise raised from None


def test_a_call_is_repeated_where_its_process_dies():
    said = []
    cluster = Cluster(FakeRay([2], dies=[1, 3]), said.append)
    cluster.start("a", divmod, 7, 2, restarts=2)
    cluster.start("b", divmod, 1, 0)
    assert cluster.num_running == 2
    ended = [cluster.next(), cluster.next()]
    assert [each.key for each in ended] == ["b", "a"] and ended[1].value == (3, 1) and cluster.num_running == 0
    assert isinstance(ended[0].error, ZeroDivisionError) and "a traceback" in str(ended[0].error.__cause__)
    assert said == ["a: its process died and is started again (The worker died)"] * 2
    cluster.start("c", divmod, 7, 2)
    cluster = Cluster(FakeRay([2], dies=[1, 2]), said.append)
    cluster.start("c", divmod, 7, 2, restarts=1)
    assert "The worker died" in str(cluster.next().error)


@pytest.mark.parametrize(("machines", "calls", "cores"), [([2], 1, 2), ([2], 3, 1), ([8, 4], 2, 4), ([0, 8], 3, 2)])
def test_cores_of_each_call(machines, calls, cores):
    assert Cluster(FakeRay(machines), silent).cores_for(calls) == cores


def test_what_no_machine_has_is_named():
    with pytest.raises(InputError, match="expected a machine with 3 cores, got at most 2"):
        Cluster(FakeRay([2]), silent).start("a", divmod, 7, 2, cores=3)
    with pytest.raises(InputError, match="expected a cluster with a GPU, got none"):
        Cluster(FakeRay([2]), silent).start("a", divmod, 7, 2, on_gpu=True)


@pytest.fixture
def silent_address():
    """A port of this machine at which nothing listens."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        yield f"127.0.0.1:{taken.getsockname()[1]}"


@needs_ray
@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_no_cluster_at_an_address(scheme, silent_address, tiny_sequence, tmp_path, capsys):
    (tmp_path / "list.txt").write_text(str(tiny_sequence))
    for words in (["train", str(tiny_sequence)], ["batch", str(tmp_path / "list.txt")]):
        began, out = time.monotonic(), tmp_path / "out"
        assert main([*words, str(out), "--ray", scheme + silent_address]) == 2
        error = capsys.readouterr().err
        assert "expected a running cluster, got" in error and error.count("\n") == 1 and not out.exists()
        assert time.monotonic() - began < 60


IN_A_CLUSTER = """
import os, subprocess, sys
from pkgutil import resolve_name
from endoprior.system.ray_cluster import connected
with connected("local", print) as cluster:
    cluster.start("module", resolve_name, "colorsys:__file__")
    cluster.start("variable", os.getenv, "OMP_WAIT_POLICY")
    values = {ended.key: ended.value for ended in (cluster.next(), cluster.next())}  # whichever ends first
    print(values["module"])
    print(values["variable"])
    import ray
    address = ray.get_runtime_context().gcs_address
    without = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    code = f"from ray._raylet import GcsClient; GcsClient(address={address!r}).internal_kv_keys(b'')"
    for environment in (without, os.environ):
        done = subprocess.run([sys.executable, "-P", "-c", code], env=environment, capture_output=True, text=True)
        print(done.returncode, "AuthenticationError" in done.stderr)
"""


@pytest.mark.slow
@needs_ray
def test_a_local_cluster_takes_no_orders_of_others_and_no_code_of_the_current_folder(tmp_path):
    (tmp_path / "colorsys.py").write_text("open('EXECUTED', 'w')")
    words = [sys.executable, "-P", "-c", IN_A_CLUSTER]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)
    module, policy, stranger, ours = done.stdout.splitlines()
    assert not module.startswith(str(tmp_path)) and not (tmp_path / "EXECUTED").exists(), done.stderr
    assert policy == "PASSIVE" and stranger == "1 True" and ours == "0 False", done.stdout


def test_ray_that_is_not_installed(tiny_sequence, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main(["train", str(tiny_sequence), str(tmp_path / "out"), "--ray", "local"]) == 2
    assert "--ray: expected Ray, got none. Fix: `pip install" in capsys.readouterr().err
    assert main(["train", str(tiny_sequence), str(tmp_path / "out"), "--ray", "local", "--view"]) == 2
    assert "--view: expected a training in this process" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_signal_that_ray_swallowed_still_interrupts():
    cluster = Cluster(FakeRay([2]), silent)
    cluster.start("one", abs, 1)
    cluster.interrupted = True
    with pytest.raises(KeyboardInterrupt):
        cluster.next()
