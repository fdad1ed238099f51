"""The doctor's probes: programs that answer, hang, die or print garbage, and the facts of this machine."""

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from types import ModuleType

import pytest
from doctor_machines import NO_TRITON, WORKING, bare_machine, program
from hypothesis import given
from hypothesis import strategies as st
from hypothesis_profiles import examples

from endoprior.doctor import Facts, examine, fixes, read_facts, read_facts_quickly
from endoprior.doctor import facts as facts_module
from endoprior.doctor.choice import choose, choose_here
from endoprior.doctor.driver import driver_answers, driver_files, read_banner, read_gpus
from endoprior.doctor.probe_process import MOST_BYTES, clean, run_program
from endoprior.doctor.records import Driver, Gpu, Gsplat, System, Torch, number
from endoprior.doctor.report import as_json


@pytest.fixture
def path(tmp_path, monkeypatch):
    return bare_machine(tmp_path, monkeypatch)


BANNER = "| NVIDIA-SMI 570.10   Driver Version: 570.124.06   CUDA Version: 12.8 |"
ROWS = "NVIDIA H200, 9.0, 143771\\nOdd, Card, 8.6, [N/A]\\ngarbage\\n, 1.0, 3\\n"


def test_nvidia_smi_answers(path):
    program(path, "nvidia-smi", f'case "$1" in --query*) printf "{ROWS}";; *) echo "{BANNER}";; esac')
    driver = driver_answers(driver_files())
    assert (driver.version, driver.cuda, driver.error) == ("570.124.06", "12.8", "")
    assert driver.gpus[0] == Gpu("NVIDIA H200", (9, 0), 143771 / 1024)
    assert driver.gpus[1:] == (Gpu("Odd, Card", (8, 6), None),)


@pytest.mark.parametrize(
    ("banner", "read"),
    [
        (BANNER, ("570.124.06", "12.8")),
        ("| NVIDIA-SMI 610.43.02  KMD Version: 610.43.02  CUDA UMD Version: 13.3 |", ("610.43.02", "13.3")),
        ("Driver Version: 580.1  CUDA Version: N/A", ("580.1", "")),
        ("CUDA CUDA Driver Version", ("", "")),
    ],
)
def test_banners_of_nvidia_smi(banner, read):
    assert read_banner(banner) == read


@examples(100)
@given(st.text(max_size=200))
def test_no_text_breaks_the_readers(text):
    read_banner(text)
    read_gpus(text)
    number(text)
    assert len(clean(text)) <= 200 and all(c.isprintable() for c in clean(text))


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ("sleep 30", "no answer in 0.5 s"),
        ("sleep 30 & sleep 30", "no answer in 0.5 s"),
        ("echo 'Failed to initialize NVML: Driver/library version mismatch'; exit 18", "version mismatch"),
        ("printf '\\377\\000\\033[31mzap'", "printed no version"),
        ("kill -9 $$", "signal 9"),
        ("exit 0", "printed no version"),
    ],
)
def test_nvidia_smi_that_hangs_fails_or_raves(path, body, says):
    tool = program(path, "nvidia-smi", body)
    began = time.monotonic()
    driver = driver_answers(Driver(1, "535.54", True, str(tool)), limit_s=0.5)
    assert time.monotonic() - began < 5
    assert says in driver.error and driver.error.isprintable() and (driver.version, driver.cuda) == ("535.54", "12.2")
    report = examine(replace(WORKING, driver=driver, torch=Torch("2.13.0", "12.6", available=False)))
    assert report.blocking.name == "driver" and report.next_step == "sudo reboot"


def test_a_program_that_prints_without_end_is_stopped():
    began = time.monotonic()
    said = run_program(["sh", "-c", "while :; do echo garbage garbage garbage; done"], 20)
    assert "without end" in said.problem and len(said.text) == MOST_BYTES and time.monotonic() - began < 15
    assert "cannot be run" in run_program(["no-such-program-here"], 1).problem
    assert run_program(["sh", "-c", "echo out; echo err >&2; exit 3"], 5).problem == "sh ended with status 3"


def test_nothing_that_was_started_is_left():
    mark = f"98{os.getpid()}"
    run_program(["sh", "-c", f"sleep {mark} & sleep {mark}"], 0.3)
    running = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True).stdout
    assert f"sleep {mark}" not in running


def test_driver_files(tmp_path, path):
    assert driver_files(tmp_path) == Driver(None)
    bus = tmp_path / "sys/bus/pci/devices"
    for name, vendor, kind in [("a", "0x10de", "0x030200"), ("b", "0x10de", "0x040300"), ("c", "0x8086", "0x030000")]:
        (bus / name).mkdir(parents=True)
        (bus / name / "vendor").write_text(vendor + "\n")
        (bus / name / "class").write_text(kind + "\n")
    (bus / "empty").mkdir()
    module = tmp_path / "proc/driver/nvidia/version"
    module.parent.mkdir(parents=True)
    module.write_text(
        "NVRM version: NVIDIA UNIX Open Kernel Module for x86_64  580.65.06  Release Build\nGCC version: 12\n"
    )
    (tmp_path / "dev").mkdir()
    (tmp_path / "dev/nvidia0").touch()
    driver = driver_answers(driver_files(tmp_path))
    assert driver == Driver(1, "580.65.06", True, "", "580.65.06", "13.0")
    (tmp_path / "dev/nvidia0").unlink()
    (tmp_path / "dev/dxg").touch()
    assert not driver_files(tmp_path).device_files, "a card of another make"
    program(path, "nvidia-smi", "exit 9")
    assert driver_files(tmp_path).device_files
    (path / "nvidia-smi").unlink()
    unreachable = Facts(System(container=True), driver_files(tmp_path), Torch("2.13.0", "13.0"))
    assert examine(unreachable).next_step == "start the container with --gpus all"


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ("raise RuntimeError('half installed')", "half installed"),
        ("import time; time.sleep(30)", "no answer"),
        ("import os; os._exit(7)", "status 7"),
        ("import os; os.abort()", "signal"),
        ("print('endoprior-probe not json'); raise SystemExit(3)", "3"),
    ],
)
def test_a_torch_that_breaks_hangs_or_dies(tmp_path, monkeypatch, body, says):
    package = tmp_path / "torch"
    package.mkdir()
    (package / "__init__.py").write_text(body)
    (package / "version.py").write_text("__version__ = '2.13.0+cu130'\ncuda: Optional[str] = '13.0'\nhip: str = None\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "torch")
    limit = 2.0 if "sleep" in body else 30.0
    torch = read_facts(limit).torch
    assert (torch.version, torch.cuda, torch.available) == ("2.13.0+cu130", "13.0", None) and says in torch.error
    assert examine(replace(WORKING, torch=torch)).blocking.name == "torch"


def test_a_torch_that_sees_cards(tmp_path, monkeypatch):
    fake = """
class version: cuda, hip = "13.0", None
__version__ = "2.13.0+cu130"
class cuda:
    def get_arch_list(): return ["sm_90"]
    def is_available(): return True
    def device_count(): return 2
    def get_device_properties(i):
        if i: raise RuntimeError("fell off the bus")
        return type("P", (), dict(name="NVIDIA H200", major=9, minor=0, total_memory=2**37))
def ones(n, device): raise RuntimeError("no kernel image is available")
"""
    (tmp_path / "torch").mkdir()
    (tmp_path / "torch/__init__.py").write_text(fake)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    torch = read_facts(30.0).torch
    assert torch.available is True
    assert torch.gpus[0] == Gpu("NVIDIA H200", (9, 0), 128.0, False, "no kernel image is available")
    assert torch.gpus[1] == Gpu("device 1", None, None, False, "fell off the bus")


def fake_gsplat(folder, backend: str, monkeypatch):
    """A package called gsplat whose backend does what `backend` says."""
    cuda = folder / "gsplat/cuda"
    cuda.mkdir(parents=True)
    (folder / "gsplat/__init__.py").write_text("")
    (cuda / "__init__.py").write_text("")
    (cuda / "_backend.py").write_text(backend)
    monkeypatch.setenv("PYTHONPATH", str(folder))
    monkeypatch.syspath_prepend(str(folder))


@pytest.mark.parametrize(
    ("backend", "says"),
    [
        ("_C = None", "no compiled code"),
        ("_C = object()", "no intersect_tile"),
        ("raise RuntimeError('nvcc fatal: unsupported gpu architecture')", "unsupported gpu"),
        ("import os; os._exit(1)", "status 1"),
    ],
)
def test_compiling_that_fails_says_why(tmp_path, monkeypatch, backend, says):
    fake_gsplat(tmp_path, backend, monkeypatch)
    facts = facts_module.compile_gsplat(NO_TRITON)
    assert facts.gsplat.loads is False and says in facts.gsplat.error
    assert examine(facts).blocking.name == "gsplat compiled" and not examine(facts).only_to_compile


@pytest.mark.slow
def test_compiling_that_works_is_timed(tmp_path, monkeypatch):
    fake_gsplat(tmp_path, "class _C: intersect_tile = None", monkeypatch)
    facts = facts_module.compile_gsplat(NO_TRITON)
    assert facts.gsplat.loads is True and 0 <= facts.gsplat.compile_seconds < 60
    assert examine(facts).gsplat


@pytest.mark.slow
def test_compiled_files_are_found_and_tried_without_importing_gsplat(tmp_path, monkeypatch):
    fake_gsplat(tmp_path, "raise SystemExit('compiles')", monkeypatch)
    (tmp_path / "gsplat/__init__.py").write_text("raise SystemExit('imported')")
    (tmp_path / "gsplat/csrc.so").write_bytes(b"no library")
    torch = replace(WORKING.torch, extensions=str(tmp_path / "cache"))
    found = facts_module.read_gsplat(torch)
    assert (found.version, found.prebuilt, found.cached) == ("?", str(tmp_path / "gsplat/csrc.so"), "")
    assert found.loads is False and "csrc.so" in found.error
    (tmp_path / "cache/gsplat_cuda").mkdir(parents=True)
    (tmp_path / "cache/gsplat_cuda/gsplat_cuda.so").write_bytes(b"no library")
    found = facts_module.read_gsplat(torch)
    assert (found.prebuilt, found.loads) == ("", False) and "gsplat_cuda.so" in found.error
    assert fixes.compile_again(replace(WORKING, gsplat=found)).startswith(f"rm -r {tmp_path}/cache/gsplat_cuda && ")


def test_quick_facts_take_no_time_and_agree_with_all_facts():
    began = time.monotonic()
    quick = read_facts_quickly()
    assert time.monotonic() - began < 1
    assert quick.torch.version.startswith("2.") and quick.system.cores >= 1
    facts = read_facts()
    assert (facts.torch.version, facts.torch.cuda) == (quick.torch.version, quick.torch.cuda)
    assert facts.torch.error == "" and facts.packages.keys() == set(facts_module.PACKAGES)
    assert choose_here("auto").device == choose("auto", facts).device
    assert json.loads(json.dumps(as_json(facts, examine(facts), "cpu", "numba", "")))["facts"]["system"]["cores"] >= 1
    assert choose_here("cpu").why == "CPU: as requested"


def test_probes_that_raise_leave_the_others(monkeypatch):
    def fails(*_):
        raise ZeroDivisionError

    for name in ("available_bytes", "driver_files", "driver_answers", "find_toolkit", "run_program"):
        monkeypatch.setattr(facts_module, name, fails)
    for name in ("torch", "gsplat"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))  # without a spec: looking for it raises ValueError
    facts = read_facts()
    assert facts.torch == Torch() and facts.gsplat == Gsplat() and facts.weights_error == "the probe of torch failed"
    assert facts.builders.compiler and examine(facts).next_step
