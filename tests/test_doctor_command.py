"""`endoprior doctor`: its table, compiling when asked, for a GPU that is here or for an image."""

import json
from dataclasses import replace

import pytest
from doctor_machines import NO_GPU, NO_TRITON, ONLY_TRITON, WORKING

from endoprior.cli import main
from endoprior.doctor import Facts, examine
from endoprior.doctor import facts as facts_module
from endoprior.doctor.records import Gsplat, Toolkit, Torch, Triton
from endoprior.doctor.report import as_json

TO_COMPILE = replace(NO_GPU, gsplat=Gsplat("1.5.3"))
FOR_IMAGES = {"TORCH_CUDA_ARCH_LIST": "9.0"}


def doctor(monkeypatch, facts, compiled=None, *options):
    """Run the command on a machine; `compiled` is gsplat after it compiled, None where it must not be asked to."""
    monkeypatch.setattr("endoprior.doctor.read_facts", lambda: facts)

    def compiles(facts):
        assert compiled is not None, "nothing to compile"
        return replace(facts, gsplat=compiled)

    monkeypatch.setattr(facts_module, "compile_gsplat", compiles)
    return main(["doctor", *options])


def test_the_command_prints_a_table(monkeypatch, capsys):
    machine = replace(NO_TRITON, gsplat=Gsplat())
    assert doctor(monkeypatch, machine) == 0
    text = capsys.readouterr().out
    assert "-> pip install gsplat\n" in text and text.count("next: ") == 1
    assert "--device auto: CPU: the GPU is ready, but gsplat: not installed" in text
    assert doctor(monkeypatch, machine, None, "--compil") == 2


def test_json_says_the_same(monkeypatch, capsys):
    assert doctor(monkeypatch, ONLY_TRITON, None, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["device"], found["backend"], found["cuda_works"]) == ("cuda", "triton", True)
    assert found["backends"] == {"triton": True, "gsplat": False} and found["next_step"].endswith("with Triton")
    assert doctor(monkeypatch, TO_COMPILE, None, "--json", "--compile") == 1
    assert "IndexError" in json.loads(capsys.readouterr().out)["compiling"]


def test_what_compile_problem_is_named_and_the_status_says_so(monkeypatch, capsys):
    assert doctor(monkeypatch, replace(WORKING, gsplat=Gsplat()), None, "--compile") == 1
    assert "gsplat was not compiled: first fix gsplat: not installed; pip install" in capsys.readouterr().out


def test_the_command_compiles_when_asked(monkeypatch, capsys):
    compiled = replace(WORKING.gsplat, compile_seconds=200.0)
    assert doctor(monkeypatch, replace(WORKING, gsplat=Gsplat("1.5.3")), compiled, "--compile") == 0
    text = capsys.readouterr().out
    assert "gsplat is compiled, ready in 200 s\n" in text and "next: nothing: CUDA works" in text
    failed = Gsplat("1.5.3", loads=False, error="nvcc died")
    assert doctor(monkeypatch, replace(WORKING, gsplat=Gsplat("1.5.3")), failed, "--compile") == 1
    assert "gsplat did not compile: nvcc died" in capsys.readouterr().out


def test_an_image_is_built_where_no_gpu_is(monkeypatch, capsys):
    assert doctor(monkeypatch, TO_COMPILE, None, "--compile") == 1
    refused = next(row for row in capsys.readouterr().out.splitlines() if "not compiled: " in row)
    assert "IndexError" in refused and "TORCH_CUDA_ARCH_LIST=9.0 endoprior doctor --compile" in refused
    machine = replace(TO_COMPILE, variables=FOR_IMAGES)
    assert doctor(monkeypatch, machine, replace(WORKING.gsplat, compile_seconds=365.0), "--compile") == 0
    assert "gsplat is compiled, ready in 365 s; no GPU to render with" in capsys.readouterr().out
    assert doctor(monkeypatch, machine, Gsplat("1.5.3", loads=False, error="nvcc died"), "--compile") == 1


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({}, ""),
        ({"variables": {}}, "IndexError"),
        ({"variables": {"TORCH_CUDA_ARCH_LIST": "native"}}, "IndexError"),
        ({"variables": {"TORCH_CUDA_ARCH_LIST": ""}}, "IndexError"),
        ({"toolkit": Toolkit(pip="/p")}, "first fix nvcc: no CUDA toolkit; pip install 'cuda-toolkit[nvcc,cccl]"),
        ({"torch": Torch("2.13.0+cpu")}, "first fix torch: 2.13.0+cpu, built without CUDA; pip uninstall"),
        ({"builders": replace(WORKING.builders, ninja="")}, "first fix ninja"),
        ({"builders": replace(WORKING.builders, c_version="")}, ""),
        ({"torch": WORKING.torch, "driver": WORKING.driver, "variables": {}}, ""),
    ],
)
def test_what_prevents_compiling(change, problem):
    found = examine(replace(TO_COMPILE, **{"variables": FOR_IMAGES, **change})).compile_problem
    assert problem in found and bool(problem) == bool(found) and "\n" not in found


def test_a_broken_gpu_is_fixed_first():
    sick = replace(WORKING.torch, gpus=(replace(WORKING.torch.gpus[0], computes=False, error="sick"),))
    machine = replace(WORKING, torch=sick, gsplat=Gsplat("1.5.3"))
    assert examine(machine).compile_problem.startswith("first fix GPU computes: ")
    assert not examine(replace(machine, variables=FOR_IMAGES)).compile_problem


@pytest.mark.parametrize(
    ("torch", "says", "step"),
    [
        (Torch(), "cannot train yet. PyTorch: not installed.", "pip install -c constraints.txt torch"),
        (Torch("2.13.0+cpu", error="no libgomp"), "2.13.0+cpu: no libgomp.", "pip install --force-reinstall -c constr"),
        (Torch("2.13.0+cpu"), "can train and render.", "nothing to install"),
    ],
)
def test_without_pytorch_the_cpu_is_not_enough(torch, says, step):
    report = examine(replace(NO_GPU, torch=torch))
    assert says in report.verdict and report.next_step.startswith(step)
    assert json.loads(json.dumps(as_json(Facts(), report, "cpu", "numba", "")))["verdict"] == report.verdict


def test_a_gpu_that_could_work_is_named_in_the_verdict():
    report = examine(replace(WORKING, gsplat=Gsplat(), triton=Triton()))
    assert report.verdict == "This computer can train and render. GPU: not used yet; Triton: not installed."
    assert examine(WORKING).verdict == "This computer can train and render. It uses its GPU."
