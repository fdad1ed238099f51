"""The doctor's judgment: one next step for every machine, the choice of the device, and the command."""

import itertools
import json
from dataclasses import replace

import pytest
from doctor_machines import CHOICES, H200, OLD_CARD, WORKING, machines
from hypothesis import given

from endoprior import device
from endoprior.checks import InputError
from endoprior.cli import main
from endoprior.doctor import Facts, examine, mend
from endoprior.doctor import facts as facts_module
from endoprior.doctor.records import Driver, Gpu, Gsplat, System, Toolkit, Torch, number


def check_advice(facts: Facts) -> None:
    """What holds for every machine."""
    report = examine(facts)
    chain = [line for line in report.lines if line.part == "cuda"]
    assert len({line.name for line in report.lines}) == len(report.lines) and len(chain) == 13
    assert report.works == all(line.state == "ok" for line in chain) == (report.blocking is None)
    assert report.next_step and "\n" not in report.next_step
    for line in report.lines:
        assert line.found and line.state in ("ok", "missing", "wrong")
        assert not line.mend or line.state != "ok", "what is right is not mended"
    if report.works:
        assert report.next_step == "nothing: CUDA works"
        return
    first = next(line for line in chain if line.state != "ok")
    assert report.blocking == first
    hopeless = first.name in ("system", "GPU")
    if not first.mend:
        assert hopeless and not any(line.mend for line in chain), "nothing is recommended that would not help"
        return
    assert report.next_step == first.mend
    torch_there = f"/cu{facts.torch.cuda.replace('.', '')}"
    if f"whl{torch_there}" in first.mend and facts.torch.cuda:
        assert facts.torch.error or number(facts.torch.version) < (2, 4), "the same build again would change nothing"
    if "cuda-toolkit-" in first.mend and facts.toolkit.nvcc:
        installs = f"cuda-toolkit-{facts.toolkit.nvcc.replace('.', '-')}"
        assert installs not in first.mend or not facts.toolkit.headers
    if "pip install 'endoprior[cuda]'" in first.mend:
        assert not facts.gsplat.version
    if "pip install ninja" in first.mend:
        assert not facts.builders.ninja and not facts.builders.ninja_beside_python
    if first.mend.startswith("export CUDA_HOME="):
        assert first.mend.split("=", 1)[1] in dict(facts.toolkit.others)


@given(machines())
def test_every_machine_gets_one_next_step_that_is_not_already_there(facts):
    check_advice(facts)
    assert device.choose("cpu", facts).device == "cpu"
    choice = device.choose("auto", facts)
    report = examine(facts)
    assert (choice.device == "cuda") == report.works and "\n" not in choice.why
    assert choice.why.startswith("CUDA: " if report.works else "CPU: ")
    if report.works or report.only_to_compile:
        assert device.choose("cuda", facts).device == "cuda"
    else:
        with pytest.raises(InputError) as refused:
            device.choose("cuda", facts)
        assert report.blocking.found.rstrip(".") in str(refused.value) and "endoprior doctor" in str(refused.value)
        assert report.blocking.mend in str(refused.value)


def test_every_pair_of_kinds_beside_a_working_rest():
    for first, second in itertools.combinations(CHOICES, 2):
        for a, b in itertools.product(CHOICES[first], CHOICES[second]):
            check_advice(replace(WORKING, **{first: a, second: b}))


def test_a_working_machine_works_and_each_missing_link_is_found():
    assert examine(WORKING).works
    broken = {
        "system": {"system": System(name="Darwin")},
        "GPU": {"driver": Driver(0), "torch": Torch("2.13.0+cpu")},
        "driver": {"driver": Driver(1), "torch": Torch("2.13.0+cpu")},
        "torch": {"torch": Torch("2.13.0+cpu")},
        "CUDA in torch": {"torch": replace(WORKING.torch, available=False, gpus=())},
        "GPU computes": {"torch": replace(WORKING.torch, gpus=(replace(H200, computes=False, error="sick"),))},
        "gsplat": {"gsplat": Gsplat()},
        "nvcc": {"toolkit": Toolkit(), "gsplat": Gsplat("1.5.3")},
        "CUDA headers": {"toolkit": replace(WORKING.toolkit, headers=False)},
        "C++ compiler": {"builders": replace(WORKING.builders, compiler_version="")},
        "Python headers": {"builders": replace(WORKING.builders, python_headers=False)},
        "ninja": {"builders": replace(WORKING.builders, ninja="")},
        "gsplat compiled": {"gsplat": Gsplat("1.5.3")},
    }
    for name, change in broken.items():
        assert examine(replace(WORKING, **change)).blocking.name == name
    only = examine(replace(WORKING, gsplat=Gsplat("1.5.3")))
    assert only.only_to_compile and only.next_step == "endoprior doctor --compile"


@pytest.mark.parametrize(
    ("serves", "card", "python", "build"),
    [
        ("13.2", (9, 0), "3.11", "cu130"),
        ("13.0", (7, 0), "3.11", "cu126"),
        ("12.4", (9, 0), "3.13", "cu126"),
        ("12.8", (12, 0), "3.11", "cu128"),
        ("13.0", (12, 0), "3.14", "cu130"),
        ("12.4", (12, 0), "3.11", ""),
        ("11.4", (8, 6), "3.11", "cu118"),
        ("11.4", (8, 6), "3.14", ""),
        ("", (8, 6), "3.11", "cu126"),
        ("13.0", (6, 1), "3.11", ""),
    ],
)
def test_torch_is_chosen_by_driver_and_card(serves, card, python, build):
    facts = Facts(System(python=python), Driver(1, "1", True, cuda=serves, gpus=(Gpu("card", card),)))
    command = mend.install_torch(facts)
    assert command.endswith(f"/whl/{build}") if build else command == ""
    # pip would keep the build for the CPU, and leave a torchvision that does not fit.
    with_cpu = replace(facts, torch=Torch("2.13.0+cpu"), packages={"torchvision": "0.28"})
    assert not build or mend.install_torch(with_cpu).startswith("pip uninstall -y torch torchvision && pip install ")


def test_toolkits_that_are_here_are_used_before_others_are_installed():
    beside = Toolkit("/usr/local", "PATH", "13.0", "", False, "", (("/usr/local/cuda-13.0", "13.0"),))
    assert examine(replace(WORKING, toolkit=beside)).next_step == "export CUDA_HOME=/usr/local/cuda-13.0"
    older = Toolkit("/usr", "PATH", "12.0", "", True)
    assert examine(replace(WORKING, toolkit=older)).next_step.endswith("whl/cu126")
    oldest = replace(WORKING, toolkit=Toolkit("/usr", "PATH", "11.5", "", True), system=System(packages="apt-get"))
    assert "cuda-toolkit-13-0" in examine(oldest).next_step
    both = replace(WORKING, toolkit=older, torch=Torch("2.13.0+cpu"))
    assert examine(both).next_step.endswith("whl/cu126"), "torch is chosen to fit the toolkit"
    assert "nvcc" not in [line.name for line in examine(both).lines if line.part == "cuda" and line.state != "ok"]
    gone = replace(WORKING, toolkit=Toolkit("/gone", "CUDA_HOME", "", "no /gone/bin/nvcc"))
    assert examine(gone).next_step == "unset CUDA_HOME"


def test_a_compiler_too_new_for_nvcc_is_replaced_by_one_that_is_here():
    builders = replace(WORKING.builders, compiler_version="16.0.1", other_gcc=(12, 14, 17))
    assert examine(replace(WORKING, builders=builders)).next_step == "export CC=gcc-14 CXX=g++-14"


def test_masked_cards_and_other_cards():
    masked = replace(WORKING, torch=Torch("2.13.0", "13.0", available=False), variables={"CUDA_VISIBLE_DEVICES": ""})
    assert examine(masked).next_step == "unset CUDA_VISIBLE_DEVICES"
    torch = replace(WORKING.torch, gpus=(OLD_CARD, H200))
    assert examine(replace(WORKING, torch=torch)).next_step == "export CUDA_VISIBLE_DEVICES=1"
    named = replace(WORKING, torch=torch, variables={"CUDA_VISIBLE_DEVICES": "2, 5"})
    assert examine(named).next_step == "export CUDA_VISIBLE_DEVICES=5"


def test_words_of_the_choice():
    assert device.choose("auto", WORKING).why == "CUDA: NVIDIA H200, torch 2.13.0+cu130, gsplat 1.5.3"
    no_cuda = device.choose("auto", replace(WORKING, torch=Torch("2.13.0+cpu")))
    assert no_cuda.why == "CPU: torch 2.13.0+cpu, built without CUDA"
    assert device.choose("auto", Facts()).why == "CPU: no NVIDIA GPU is seen"
    assert "minutes" in device.choose("cuda", replace(WORKING, gsplat=Gsplat("1.5.3"))).why
    assert "doctor --compile" in device.choose("auto", replace(WORKING, gsplat=Gsplat("1.5.3"))).why


def test_the_command_prints_a_table(monkeypatch, capsys):
    monkeypatch.setattr("endoprior.doctor.look", lambda: replace(WORKING, gsplat=Gsplat()))
    monkeypatch.setattr(facts_module, "compile_gsplat", lambda facts: pytest.fail("nothing to compile"))
    assert main(["doctor", "--compile"]) == 0
    text = capsys.readouterr().out
    assert "-> pip install 'endoprior[cuda]'" in text and text.count("next: ") == 1
    assert "not compiled: first mend gsplat" in text
    assert "--device auto: CPU: gsplat: not installed" in text
    assert main(["doctor", "--compil"]) == 2


def test_the_command_compiles_when_asked(monkeypatch, capsys):
    monkeypatch.setattr("endoprior.doctor.look", lambda: replace(WORKING, gsplat=Gsplat("1.5.3")))
    compiled = replace(WORKING, gsplat=replace(WORKING.gsplat, compile_seconds=200.0))
    monkeypatch.setattr(facts_module, "compile_gsplat", lambda facts: compiled)
    assert main(["doctor", "--compile"]) == 0
    text = capsys.readouterr().out
    assert "ready in 200 s" in text and "next: nothing: CUDA works" in text


def test_json_of_this_machine(capsys):
    assert main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found) == {
        "version", "device", "why", "cuda_works", "only_to_compile", "blocking", "next_step", "lines", "facts",
    }  # fmt: skip
    assert all(set(line) == {"part", "name", "state", "found", "mend"} for line in found["lines"])
    names = [line["name"] for line in found["lines"] if line["part"] == "cuda"]
    assert names == [
        "system", "GPU", "driver", "torch", "CUDA in torch", "GPU computes", "gsplat", "nvcc", "CUDA headers",
        "C++ compiler", "Python headers", "ninja", "gsplat compiled",
    ]  # fmt: skip
    assert set(found["facts"]) == {
        "system", "driver", "torch", "gsplat", "toolkit", "builders", "packages",
        "weights", "weights_error", "variables",
    }  # fmt: skip
    assert (found["device"] == "cuda") == found["cuda_works"]
    assert found["next_step"]


def test_variables_of_ours_are_shown_and_slips_are_found():
    variables = {"ENDOPRIOR_WEIGTHS": "w", "ENDOPRIOR_CACHE_GB": "much", "ENDOPRIOR_WEIGHTS": "w", "CC": "gcc-12"}
    lines = {line.name: line for line in examine(replace(WORKING, variables=variables)).lines}
    states = {name: lines[name].state for name in variables}
    assert states == {
        "ENDOPRIOR_WEIGTHS": "wrong", "ENDOPRIOR_CACHE_GB": "wrong", "ENDOPRIOR_WEIGHTS": "ok", "CC": "ok",
    }  # fmt: skip
    assert lines["ENDOPRIOR_WEIGTHS"].mend == "unset ENDOPRIOR_WEIGTHS"
