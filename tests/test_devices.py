"""The choice of the device and `endoprior doctor`: a backend is tried in a process that may fail in any way."""

import sys
from dataclasses import replace

import pytest
import torch
from gsplat_stand_in import loaded

from endoprior.cli import devices, main
from endoprior.cli.devices import DeviceChoice, Trial, choose, try_backend, why_no_gpu
from endoprior.core.checks import InputError
from endoprior.render import trial


@pytest.fixture(autouse=True)
def _nothing_is_known():
    yield
    choose.cache_clear()
    try_backend.cache_clear()


@pytest.fixture
def python(monkeypatch, tmp_path):
    """Makes the processes of trials run the body of a shell script."""

    def runs(body):
        script = tmp_path / "python"
        script.write_text(f"#!/bin/sh\n{body}\n")
        script.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(script))

    return runs


def machine(monkeypatch, problem="", **works):
    """A machine whose backends `works` names: what each trial finds, None where it fails."""
    monkeypatch.setattr(devices, "why_no_gpu", lambda: problem)
    monkeypatch.setattr(devices, "find_spec", lambda name: works.keys() >= {name} or None)
    found = {name: Trial(words is not None, words or "libcuda.so not found") for name, words in works.items()}
    monkeypatch.setattr(devices, "try_backend", found.__getitem__)


def test_the_backend_of_the_cpu_agrees_with_the_reference():
    assert "differs from `reference` by" in trial.attempt("numba", compiles=False)


@pytest.mark.parametrize(
    "wrong_image",
    [
        lambda out: replace(out, alpha=out.alpha + 0.002),
        lambda out: replace(out, depth=out.depth * 1.02),
        lambda out: replace(out, color=out.color * float("nan")),
    ],
)
def test_a_backend_that_renders_wrongly_does_not_work(monkeypatch, capsys, wrong_image):
    load = trial.load

    def wrong(backend):
        def render(*args, **options):
            out = load("reference")(*args, **options)
            return out if backend == "reference" else wrong_image(out)

        return render

    monkeypatch.setattr(trial, "load", wrong)
    assert trial.main("numba") == 1
    assert capsys.readouterr().out.strip().startswith("ArithmeticError: differs from `reference` by ")


def test_gsplat_is_never_compiled_unasked(monkeypatch, tmp_path):
    (tmp_path / "gsplat").mkdir()
    (tmp_path / "gsplat" / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "cache"))
    assert not trial.gsplat_is_compiled()
    with pytest.raises(InputError, match="not compiled"):
        trial.attempt("gsplat", compiles=False)
    (tmp_path / "cache" / "gsplat_cuda" / "gsplat_cuda.so").write_bytes(b"")
    assert trial.gsplat_is_compiled()


def test_gsplat_compiles_where_no_gpu_is(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    loaded(monkeypatch, kernels=object())
    assert trial.attempt("gsplat", compiles=True) == "compiled; no GPU to render with"
    loaded(monkeypatch, kernels=None)
    with pytest.raises(InputError, match="no CUDA toolkit"):
        trial.attempt("gsplat", compiles=True)


@pytest.mark.parametrize(
    ("body", "works", "found"),
    [
        ("echo noise; echo 'GPU, torch 2'", True, "GPU, torch 2"),
        ("echo no driver; exit 1", False, "no driver"),
        ("exit 1", False, "no answer"),
        ("kill -SEGV $$", False, "ended by signal 11"),
        ("sleep 60 & wait", False, "no answer in 0.5 s"),
        ('echo "$*"', True, "-P -m endoprior.system.run_module endoprior.render.trial triton"),
    ],
)
def test_a_trial_may_fail_in_any_way(python, monkeypatch, body, works, found):
    python(body)
    if "sleep" in body:
        monkeypatch.setattr(devices, "TRIAL_LIMIT_S", 0.5)
    told = try_backend("triton")
    assert (told.works, told.found) == (works, found)


def test_a_computer_without_a_gpu_is_found_without_torch(monkeypatch):
    monkeypatch.setattr(devices, "DEVICE_FILES", ())
    monkeypatch.setitem(sys.modules, "torch", None)
    assert why_no_gpu() == "no NVIDIA GPU found"


def test_torch_for_the_cpu_is_named(monkeypatch):
    monkeypatch.setattr(devices, "DEVICE_FILES", ("/dev/null",))
    monkeypatch.setattr(torch.version, "cuda", None)
    assert why_no_gpu() == f"torch {torch.__version__}, built without CUDA"
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    assert why_no_gpu() == ""


@pytest.mark.parametrize(
    ("works", "backend", "why"),
    [
        ({"gsplat": "H200, gsplat 1.5.3; agrees", "triton": "H200"}, "gsplat", "CUDA: H200, gsplat 1.5.3"),
        ({"gsplat": None, "triton": "H200; agrees"}, "triton", "CUDA: H200"),
    ],
)
def test_the_first_backend_that_works_is_taken(monkeypatch, works, backend, why):
    machine(monkeypatch, **works)
    assert choose("auto") == choose("cuda") == DeviceChoice("cuda", backend, why)
    assert choose("cpu") == DeviceChoice("cpu", "numba", "CPU: as requested")


def test_without_a_backend_that_works_the_cpu_is_taken(monkeypatch):
    machine(monkeypatch, triton=None)
    assert choose("auto") == DeviceChoice("cpu", "numba", "CPU: gsplat: not installed; triton: libcuda.so not found")
    with pytest.raises(InputError, match=r"^--device cuda: .*libcuda.so not found.*endoprior doctor"):
        choose("cuda")


@pytest.fixture
def trials(monkeypatch):
    """What `doctor` finds with each backend."""
    found = {"numba": Trial(True, "differs little")}
    monkeypatch.setattr("endoprior.cli.doctor.try_backend", lambda name, compiles: found[name])
    return found


def test_doctor_tells_what_is_there_and_what_fails(trials, monkeypatch, capsys):
    error = "RuntimeError: no compiler"
    trials |= {"triton": Trial(False, error, f"Python.h is missing\n{error}"), "gsplat": Trial(False, "not installed")}
    monkeypatch.setattr("endoprior.cli.doctor.why_no_gpu", lambda: "")
    machine(monkeypatch, triton=None)
    assert main(["doctor"]) == 0
    text = capsys.readouterr().out
    assert "numba     works: differs little" in text and f"triton    fails: {error}" in text and "Python.h is" in text
    assert "--device auto: CPU: gsplat: not installed" in text and "gpu.md" in text and "torch     2." in text
    assert main(["doctor", "--compile"]) == 1
    trials["numba"] = Trial(False, "ImportError: numba")
    assert main(["doctor"]) == 1 and "install.md" in capsys.readouterr().out


def test_doctor_of_a_computer_without_a_gpu(trials, monkeypatch, capsys):
    monkeypatch.setattr("endoprior.cli.doctor.why_no_gpu", lambda: "no NVIDIA GPU found")
    machine(monkeypatch, "no NVIDIA GPU found")
    assert main(["doctor"]) == 0
    text = capsys.readouterr().out
    assert "GPU       no NVIDIA GPU found; everything runs on the CPU" in text and "triton" not in text
