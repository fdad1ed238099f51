"""The doctor and Triton: the backend that needs fewer fixes, and whether Triton computes."""

import json
import sys
from dataclasses import asdict, replace

import pytest
from doctor_machines import H200, NO_GPU, NO_TRITON, ONLY_TRITON, WORKING

from endoprior.core.checks import InputError
from endoprior.doctor import examine, read_facts
from endoprior.doctor import facts as facts_module
from endoprior.doctor.choice import Choice, choose
from endoprior.doctor.probe_process import MARK, Answer, run_program
from endoprior.doctor.records import Gsplat, System, Toolkit, Torch, Triton
from endoprior.doctor.report import table

INSTALL = ["pip install gsplat"]


def test_triton_alone_is_enough():
    report = examine(ONLY_TRITON)
    assert (report.works, report.triton, report.gsplat) == (True, True, False)
    assert report.next_step == "nothing: CUDA works, with Triton"
    text = "\n".join(table(report))
    assert "Triton: works" in text and "gsplat: not needed" in text
    assert [line.fix for line in report.lines if line.part == "gsplat" and line.fix] == INSTALL, "and no more"
    choice = choose("auto", ONLY_TRITON)
    assert choice == Choice("cuda", "triton", "CUDA: NVIDIA H200, torch 2.13.0+cu130, Triton 3.7.1")
    assert choose("cuda", ONLY_TRITON) == choice


def test_gsplat_is_taken_where_both_work_and_never_compiled_where_triton_works():
    assert choose("auto", WORKING).backend == choose("cuda", WORKING).backend == "gsplat"
    assert examine(WORKING).next_step == "nothing: CUDA works, with Triton and gsplat"
    to_compile = replace(WORKING, gsplat=Gsplat("1.5.3"))
    for wanted in ("auto", "cuda"):
        choice = choose(wanted, to_compile)
        assert (choice.device, choice.backend) == ("cuda", "triton")
        assert choice.why.endswith("Triton 3.7.1; gsplat is not compiled")
    assert choose("auto", NO_TRITON).backend == "gsplat"
    with pytest.raises(InputError, match=r"got Triton: not installed\. Fix: pip install triton==3\.7\.1"):
        choose("cuda", replace(ONLY_TRITON, triton=Triton(wanted="triton==3.7.1")))


@pytest.mark.parametrize(
    ("changes", "step"),
    [
        ({}, "pip install triton==3.7.1"),
        ({"triton": Triton()}, "pip install triton"),
        ({"triton": Triton("3.0", "triton==3.7.1", False, "KeyError: 'sm_120'")}, "pip install triton==3.7.1"),
        # No fix of Triton is known: gsplat is next.
        ({"triton": Triton("3.7.1", "triton==3.7.1", False, "KeyError: 'sm_120'")}, "endoprior doctor --compile"),
        ({"system": System("Windows")}, "endoprior doctor --compile"),
        # One step each: Triton, which compiles in seconds. Two against one: gsplat.
        ({"builders": replace(WORKING.builders, c_version="")}, "endoprior doctor --compile"),
        ({"triton": WORKING.triton, "gsplat": Gsplat(), "builders": replace(WORKING.builders, c_version="")}, "g++"),
        ({"gsplat": Gsplat(), "toolkit": Toolkit()}, "pip install triton==3.7.1"),
        ({"torch": Torch("2.13.0+cpu")}, "whl/cu130"),
        ({"builders": replace(WORKING.builders, python_headers=False)}, "install the headers of Python 3.11"),
    ],
)
def test_the_backend_with_fewer_fixes_is_named(changes, step):
    machine = replace(WORKING, triton=Triton(wanted="triton==3.7.1"), gsplat=Gsplat("1.5.3"))
    report = examine(replace(machine, **changes))
    assert not report.works and step in report.next_step


@pytest.mark.parametrize(
    ("error", "step"),
    [
        ("libcuda.so cannot found!", "sudo ldconfig"),
        ("cuda_utils.c:5:10: fatal error: stdio.h: No such file or directory", "install g++"),
        ("[Errno 13] Permission denied: '/.triton'", "export TRITON_CACHE_DIR="),
        ("[Errno 28] No space left on device", "export TRITON_CACHE_DIR="),
    ],
)
def test_errors_of_triton_have_fixes(error, step):
    machine = replace(ONLY_TRITON, triton=Triton("3.7.1", "triton==3.7.1", False, error))
    report = examine(machine)
    assert report.next_step.startswith(step) and report.blocking.found == f"3.7.1: {error}"
    assert choose("auto", machine).device == "cpu"


def test_interpreted_kernels_do_not_use_the_gpu():
    machine = replace(ONLY_TRITON, variables={"TRITON_INTERPRET": "1"})
    assert examine(machine).next_step == "unset TRITON_INTERPRET"
    assert examine(replace(machine, variables={"TRITON_INTERPRET": "0"})).works


def test_without_a_gpu_nothing_is_recommended():
    report = examine(NO_GPU)
    assert not report.works and report.next_step == "nothing to install. Everything runs on the CPU."
    text = "\n".join(table(report))
    assert text.startswith("This computer can train and render. GPU: none found; everything runs on the CPU.\n\n")
    assert "missing" not in text and "wrong" not in text and len(text.splitlines()) <= 18
    gpu = [" ".join(line.split()) for line in text.splitlines() if "GPU" in line][1:]
    assert gpu == ["optional GPU none found; start a container with `--gpus all` to use the host's GPU"]
    assert not any(name in text for name in ("nvcc", "C compiler", "Triton"))
    no_cuda = examine(replace(WORKING, system=System("Darwin")))
    assert "GPU: Darwin x86_64: CUDA does not support it; everything runs on the CPU." in table(no_cuda)[0]


FAKE_TORCH = """
class version: cuda, hip = "13.0", None
__version__ = "2.13.0+cu130"
class cuda:
    def get_arch_list(): return ["sm_90"]
    def is_available(): return True
    def device_count(): return 1
    def get_device_properties(i):
        return type("P", (), dict(name="NVIDIA H200", major=9, minor=0, total_memory=2**37))
class ones:
    def __init__(self, *_, **__): pass
    def __add__(self, _): return self
    def sum(self): return self
    def item(self): return 4.0
zeros_like = ones
"""
FAKE_TRITON = """
__version__ = "3.7.1"
class Kernel:
    def __getitem__(self, grid): return launch
def launch(*_, **__):
    import os, sys, time
    {launch}
def jit(_): return Kernel()
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("launch", "computes", "says"),
    [
        ("pass", True, ""),
        ("raise RuntimeError('0 active drivers')", False, "0 active drivers"),
        ("sys.stderr.write('x.c:1:9: fatal error: Python.h: None\\n'); 1 / 0", False, "x.c:1:9: fatal error: Python.h"),
        ("os._exit(3)", False, "status 3"),
        ("os.abort()", False, "signal 6"),
        ("time.sleep(60)", False, "no answer in 3 s"),
    ],
)
def test_triton_is_tried_and_may_crash_or_hang(tmp_path, monkeypatch, launch, computes, says):
    for name, text in (("torch", FAKE_TORCH), ("triton", FAKE_TRITON.format(launch=launch))):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(text)
    (tmp_path / "triton/language.py").write_text("constexpr = int")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    facts = read_facts(3.0 if "sleep" in launch else 30.0)
    torch, triton = facts.torch, facts.triton
    seen = (torch.version, torch.available, torch.gpus[0].computes, torch.error)
    assert seen == ("2.13.0+cu130", True, True, ""), "torch is checked alone"
    assert (triton.version, triton.computes) == ("3.7.1", computes) and says in triton.error


@pytest.mark.parametrize(
    ("package", "version", "says"),
    [("__version__ = '3.7.1'", "3.7.1", ""), ("raise ImportError('libtriton.so')", "", "libtriton.so"), (None, "", "")],
)
def test_triton_that_cannot_be_imported(tmp_path, monkeypatch, package, version, says):
    (tmp_path / "torch").mkdir()
    (tmp_path / "torch/__init__.py").write_text("class version: cuda, hip = None, None\n__version__ = '2.13.0+cpu'")
    if package:
        (tmp_path / "triton.py").write_text(package)
    else:
        (tmp_path / "triton.py").write_text("raise ModuleNotFoundError(name='triton')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    triton = read_facts(30.0).triton
    assert (triton.version, triton.computes, triton.error) == (version, None, says)


def triton_after(found: dict, monkeypatch) -> Triton:
    """What is read of Triton when the probe of torch prints `found` and then hangs."""
    answer = Answer(MARK + json.dumps(found), "python gave no answer in 90 s")
    monkeypatch.setattr(facts_module, "run_program", lambda *_: answer)
    return read_facts().triton


@pytest.mark.parametrize(
    ("requires", "wanted"),
    [
        (["filelock", 'triton==3.7.1; platform_system == "Linux"'], "triton==3.7.1"),
        (['triton (==3.0.0) ; platform_system == "Linux"'], "triton==3.0.0"),
        (["pytorch-triton-rocm==3.0"], ""),
        (None, ""),
    ],
)
def test_the_triton_that_torch_names(monkeypatch, requires, wanted):
    monkeypatch.setattr(facts_module.metadata, "requires", lambda _: requires)
    assert triton_after({}, monkeypatch).wanted == wanted


def test_a_probe_that_answers_nothing_about_triton(monkeypatch):
    found = {"gpus": [asdict(H200)], "triton": {"version": "3.7.1"}}
    assert triton_after(found, monkeypatch).error == "python gave no answer in 90 s"
    without = triton_after(found | {"triton": {}}, monkeypatch)
    assert without.computes is None, "without Triton there is nothing to try"
    assert triton_after(found | {"gpus": []}, monkeypatch).computes is None


@pytest.mark.slow
def test_the_kernel_adds(monkeypatch):
    """Interpreted: here is no GPU."""
    pytest.importorskip("triton")
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    code = "from endoprior.doctor.triton_probe import adds; print(adds('cpu'))"
    assert run_program([sys.executable, "-c", code], 60).text.strip().endswith("True")
