"""The doctor's judgment: one next step for every machine, the choice of the device, and the command."""

import itertools
import json
from dataclasses import replace

import pytest
from doctor_machines import CHOICES, H200, NO_TRITON, OLD_CARD, WORKING, machines
from hypothesis import given

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.doctor import Facts, examine, mend
from endoprior.doctor.records import Driver, Gpu, Gsplat, System, Toolkit, Torch, Triton, number
from endoprior.system import devices as device


def check_advice(facts: Facts) -> None:
    """What holds for every machine."""
    report = examine(facts)
    chain = [line for line in report.lines if line.part == "cuda"]
    ways = {part: [line for line in report.lines if line.part == part] for part in ("triton", "gsplat")}
    assert len({line.name for line in report.lines}) == len(report.lines)
    assert (len(chain), *map(len, ways.values())) == (6, 3, 7)
    right = {part: all(line.state == "ok" for line in (*chain, *lines)) for part, lines in ways.items()}
    assert report.triton == right["triton"]
    assert report.gsplat == (right["gsplat"] and (facts.builders.python_headers or bool(facts.gsplat.prebuilt)))
    assert report.works == (report.triton or report.gsplat) == (report.blocking is None)
    if report.only_to_compile:
        assert [line.name for line in (*chain, *ways["gsplat"]) if line.state != "ok"] == ["gsplat compiled"]
    assert report.next_step and "\n" not in report.next_step + report.hinders_compiling
    for line in report.lines:
        assert line.found and line.state in ("ok", "missing", "wrong")
        assert not line.mend or line.state != "ok", "what is right is not mended"
    check_ways(report.works, ways)
    if report.works:
        assert report.next_step.startswith("nothing: CUDA works, by ")
        return
    first = report.blocking
    assert first == next((line for line in chain if line.state != "ok"), first) and first in report.lines
    hopeless = first.name in ("system", "GPU")
    if not first.mend:
        assert hopeless and not any(line.mend for line in (*chain, *ways["triton"], *ways["gsplat"]))
        return
    assert report.next_step == first.mend
    torch_there = f"/cu{facts.torch.cuda.replace('.', '')}"
    if f"whl{torch_there}" in first.mend and facts.torch.cuda:
        assert facts.torch.error or number(facts.torch.version) < (2, 4), "the same build again would change nothing"
    if "cuda-toolkit" in first.mend and facts.toolkit.nvcc:
        installs = (f"cuda-toolkit-{facts.toolkit.nvcc.replace('.', '-')}", f"=={facts.toolkit.nvcc}.*")
        assert not any(name in first.mend for name in installs) or not facts.toolkit.headers or not facts.toolkit.cudart
    if "pip install 'endoprior[cuda]'" in first.mend:
        assert not facts.gsplat.version
    if first.mend.startswith("pip install triton"):
        assert not facts.triton.version
    if "pip install ninja" in first.mend:
        assert not facts.builders.ninja and not facts.builders.ninja_beside_python
    if first.mend.startswith("export CUDA_HOME="):
        assert first.mend.split("=", 1)[1] in dict(facts.toolkit.others)


def check_ways(works: bool, ways: dict[str, list]) -> None:
    """At most one of the two ways is mended at all its steps, the one with fewer of them; none if one works."""
    wrong = {
        part: [line for line in lines if line.state != "ok" and line.name != "Python headers"]  # both ways need them
        for part, lines in ways.items()
    }
    longer = [part for part, lines in wrong.items() if sum(bool(line.mend) for line in lines) <= 1 < len(lines)]
    both = all(len(lines) > 1 for lines in wrong.values())
    assert longer or not both
    if works:
        assert all(sum(bool(line.mend) for line in lines) <= 1 for lines in wrong.values())


@given(machines())
def test_every_machine_gets_one_next_step_that_is_not_already_there(facts):
    check_advice(facts)
    assert device.choose("cpu", facts).device == "cpu"
    choice = device.choose("auto", facts)
    report = examine(facts)
    assert choice.device == ("cuda" if report.works else "cpu") and "\n" not in choice.why
    assert choice.backend == ("cuda" if report.gsplat else "triton" if report.triton else "cpu")
    assert choice.why.startswith("CUDA: " if report.works else "CPU: ")
    if report.works:
        assert device.choose("cuda", facts) == choice
    elif report.only_to_compile:
        forced = device.choose("cuda", facts)
        assert (forced.device, forced.backend) == ("cuda", "cuda") and "compiles itself first" in forced.why
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
    assert examine(WORKING).works and examine(NO_TRITON).gsplat and not examine(NO_TRITON).triton
    broken = {
        "system": {"system": System(name="Darwin")},
        "GPU": {"driver": Driver(0), "torch": Torch("2.13.0+cpu")},
        "driver": {"driver": Driver(1), "torch": Torch("2.13.0+cpu")},
        "torch": {"torch": Torch("2.13.0+cpu")},
        "CUDA in torch": {"torch": replace(WORKING.torch, available=False, gpus=())},
        "GPU computes": {"torch": replace(WORKING.torch, gpus=(replace(H200, computes=False, error="sick"),))},
    }
    for name, change in broken.items():
        assert examine(replace(WORKING, **change)).blocking.name == name
    no_way = {
        "gsplat": {"gsplat": Gsplat()},
        "nvcc": {"toolkit": Toolkit(), "gsplat": Gsplat("1.5.3")},
        "CUDA headers": {"toolkit": replace(WORKING.toolkit, headers=False)},
        "CUDA library": {"toolkit": replace(WORKING.toolkit, cudart=False), "gsplat": Gsplat("1.5.3")},
        "C++ compiler": {"builders": replace(WORKING.builders, compiler_version="")},
        "Python headers": {"builders": replace(WORKING.builders, python_headers=False)},
        "ninja": {"builders": replace(WORKING.builders, ninja="")},
        "gsplat compiled": {"gsplat": Gsplat("1.5.3")},
    }
    for name, change in no_way.items():
        assert examine(replace(NO_TRITON, **change)).blocking.name == name
    only = examine(replace(NO_TRITON, gsplat=Gsplat("1.5.3")))
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


def test_masked_cards_and_other_cards():
    masked = replace(WORKING, torch=Torch("2.13.0", "13.0", available=False), variables={"CUDA_VISIBLE_DEVICES": ""})
    assert examine(masked).next_step == "unset CUDA_VISIBLE_DEVICES"
    torch = replace(WORKING.torch, gpus=(OLD_CARD, H200))
    assert examine(replace(WORKING, torch=torch)).next_step == "export CUDA_VISIBLE_DEVICES=1"
    named = replace(WORKING, torch=torch, variables={"CUDA_VISIBLE_DEVICES": "2, 5"})
    assert examine(named).next_step == "export CUDA_VISIBLE_DEVICES=5"


def test_words_of_the_choice():
    assert device.choose("auto", WORKING).why == "CUDA: NVIDIA H200, torch 2.13.0+cu130, gsplat 1.5.3"
    assert device.choose("cpu", WORKING) == device.Choice("cpu", "cpu", "CPU: as asked")
    no_cuda = device.choose("auto", replace(WORKING, torch=Torch("2.13.0+cpu")))
    assert no_cuda.why == "CPU: torch 2.13.0+cpu, built without CUDA"
    assert device.choose("auto", Facts()).why == "CPU: no NVIDIA GPU is seen"
    assert "minutes" in device.choose("cuda", replace(NO_TRITON, gsplat=Gsplat("1.5.3"))).why
    assert "doctor --compile" in device.choose("auto", replace(NO_TRITON, gsplat=Gsplat("1.5.3"))).why
    no_way = device.choose("auto", replace(WORKING, gsplat=Gsplat(), triton=Triton()))
    assert no_way.why == "CPU: the GPU is ready, but Triton: not installed; see `endoprior doctor`"


def test_json_of_this_machine(capsys):
    assert main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found) == {
        "version", "device", "backend", "why", "cuda_works", "ways", "only_to_compile", "compiling", "blocking",
        "next_step", "lines", "facts",
    }  # fmt: skip
    assert all(set(line) == {"part", "name", "state", "found", "mend"} for line in found["lines"])
    names = [line["name"] for line in found["lines"] if line["part"] in ("cuda", "triton", "gsplat")]
    assert names == [
        "system", "GPU", "driver", "torch", "CUDA in torch", "GPU computes", "C compiler", "Python headers", "Triton",
        "gsplat", "nvcc", "CUDA headers", "CUDA library", "C++ compiler", "ninja", "gsplat compiled",
    ]  # fmt: skip
    assert set(found["facts"]) == {
        "system", "driver", "torch", "triton", "gsplat", "toolkit", "builders", "packages",
        "weights", "weights_error", "variables",
    }  # fmt: skip
    assert (found["device"] == "cuda") == found["cuda_works"] == any(found["ways"].values())
    assert found["next_step"]


def test_variables_of_ours_are_shown_and_slips_are_found():
    variables = {"ENDOPRIOR_WEIGTHS": "w", "ENDOPRIOR_CACHE_GB": "much", "ENDOPRIOR_WEIGHTS": "w", "CC": "gcc-12"}
    lines = {line.name: line for line in examine(replace(WORKING, variables=variables)).lines}
    states = {name: lines[name].state for name in variables}
    assert states == {
        "ENDOPRIOR_WEIGTHS": "wrong", "ENDOPRIOR_CACHE_GB": "wrong", "ENDOPRIOR_WEIGHTS": "ok", "CC": "ok",
    }  # fmt: skip
    assert lines["ENDOPRIOR_WEIGTHS"].mend == "unset ENDOPRIOR_WEIGTHS"
