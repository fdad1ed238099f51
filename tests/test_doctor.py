"""The doctor's diagnosis: one next step for every machine, the choice of the device, and JSON."""

import itertools
import json
from dataclasses import replace

import pytest
from doctor_machines import CHOICES, H200, NO_TRITON, OLD_CARD, WORKING, machines
from hypothesis import given
from hypothesis_profiles import examples

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.doctor import Facts, examine, fixes
from endoprior.doctor.choice import Choice, choose
from endoprior.doctor.records import Driver, Gpu, Gsplat, System, Toolkit, Torch, Triton, number


def check_advice(facts: Facts) -> None:
    """What holds for every machine."""
    report = examine(facts)
    chain = [line for line in report.lines if line.part == "cuda"]
    backends = {part: [line for line in report.lines if line.part == part] for part in ("triton", "gsplat")}
    assert len({line.name for line in report.lines}) == len(report.lines)
    assert (len(chain), *map(len, backends.values())) == (6, 3, 7)
    right = {part: all(line.state == "ok" for line in (*chain, *lines)) for part, lines in backends.items()}
    assert report.triton == right["triton"]
    assert report.gsplat == (right["gsplat"] and (facts.builders.python_headers or bool(facts.gsplat.prebuilt)))
    assert report.works == (report.triton or report.gsplat) == (report.blocking is None)
    if report.only_to_compile:
        assert [line.name for line in (*chain, *backends["gsplat"]) if line.state != "ok"] == ["gsplat compiled"]
    assert report.next_step and "\n" not in report.next_step + report.compile_problem
    for line in report.lines:
        assert line.found and line.state in ("ok", "missing", "wrong", "optional")
        assert not line.fix or line.state != "ok", "what is ok needs no fix"
    check_backends(report.works, backends)
    if report.works:
        assert report.next_step.startswith("nothing: CUDA works, with ")
        return
    first = report.blocking
    assert first == next((line for line in chain if line.state != "ok"), first) and first in report.lines
    no_gpu = first.name in ("system", "GPU")
    if not first.fix:
        assert (
            no_gpu
            and not report.has_usable_gpu
            and not any(line.fix for line in (*chain, *backends["triton"], *backends["gsplat"]))
        )
        return
    assert report.next_step == first.fix
    torch_there = f"/cu{facts.torch.cuda.replace('.', '')}"
    if f"whl{torch_there}" in first.fix and facts.torch.cuda:
        assert facts.torch.error or number(facts.torch.version) < (2, 4), "the same build again would change nothing"
    if "cuda-toolkit" in first.fix and facts.toolkit.nvcc:
        installs = (f"cuda-toolkit-{facts.toolkit.nvcc.replace('.', '-')}", f"=={facts.toolkit.nvcc}.*")
        assert not any(name in first.fix for name in installs) or not facts.toolkit.headers or not facts.toolkit.cudart
    if first.fix == "pip install gsplat":
        assert not facts.gsplat.version
    if first.fix.startswith("pip install triton"):
        assert not facts.triton.version
    if "pip install ninja" in first.fix:
        assert not facts.builders.ninja and not facts.builders.ninja_beside_python
    if first.fix.startswith("export CUDA_HOME="):
        assert first.fix.split("=", 1)[1] in dict(facts.toolkit.others)


def check_backends(works: bool, backends: dict[str, list]) -> None:
    """Only the backend that needs fewer fixes has more than one; none if one works."""
    wrong = {
        part: [line for line in lines if line.state != "ok" and line.name != "Python headers"]  # both ways need them
        for part, lines in backends.items()
    }
    harder = [part for part, lines in wrong.items() if sum(bool(line.fix) for line in lines) <= 1 < len(lines)]
    both = all(len(lines) > 1 for lines in wrong.values())
    assert harder or not both
    if works:
        assert all(sum(bool(line.fix) for line in lines) <= 1 for lines in wrong.values())


@examples(100)
@given(machines())
def test_every_machine_gets_one_next_step_that_is_not_done_yet(facts):
    check_advice(facts)
    assert choose("cpu", facts).device == "cpu"
    choice = choose("auto", facts)
    report = examine(facts)
    assert choice.device == ("cuda" if report.works else "cpu") and "\n" not in choice.why
    assert choice.backend == ("gsplat" if report.gsplat else "triton" if report.triton else "numba")
    assert choice.why.startswith("CUDA: " if report.works else "CPU: ")
    if report.works:
        assert choose("cuda", facts) == choice
    elif report.only_to_compile:
        forced = choose("cuda", facts)
        assert (forced.device, forced.backend) == ("cuda", "gsplat") and "first compiles itself" in forced.why
    else:
        with pytest.raises(InputError) as refused:
            choose("cuda", facts)
        assert report.blocking.found.rstrip(".") in str(refused.value) and "endoprior doctor" in str(refused.value)
        assert report.blocking.fix in str(refused.value)


def test_every_pair_of_kinds_beside_a_working_rest():
    for first, second in itertools.combinations(CHOICES, 2):
        for a, b in itertools.product(CHOICES[first], CHOICES[second]):
            check_advice(replace(WORKING, **{first: a, second: b}))


def test_a_working_machine_works_and_each_missing_line_is_found():
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
def test_torch_is_chosen_by_driver_and_gpu(serves, card, python, build):
    facts = Facts(System(python=python), Driver(1, "1", True, cuda=serves, gpus=(Gpu("card", card),)))
    command = fixes.install_torch(facts)
    assert command.endswith(f"/whl/{build}") if build else command == ""
    # pip would keep the build for the CPU, and leave a torchvision that does not fit.
    with_cpu = replace(facts, torch=Torch("2.13.0+cpu"), packages={"torchvision": "0.28"})
    assert not build or fixes.install_torch(with_cpu).startswith("pip uninstall -y torch torchvision && pip install ")


def test_masked_gpus_and_other_gpus():
    masked = replace(WORKING, torch=Torch("2.13.0", "13.0", available=False), variables={"CUDA_VISIBLE_DEVICES": ""})
    assert examine(masked).next_step == "unset CUDA_VISIBLE_DEVICES"
    torch = replace(WORKING.torch, gpus=(OLD_CARD, H200))
    assert examine(replace(WORKING, torch=torch)).next_step == "export CUDA_VISIBLE_DEVICES=1"
    named = replace(WORKING, torch=torch, variables={"CUDA_VISIBLE_DEVICES": "2, 5"})
    assert examine(named).next_step == "export CUDA_VISIBLE_DEVICES=5"


def test_words_of_the_choice():
    assert choose("auto", WORKING).why == "CUDA: NVIDIA H200, torch 2.13.0+cu130, gsplat 1.5.3"
    assert choose("cpu", WORKING) == Choice("cpu", "numba", "CPU: as requested")
    no_cuda = choose("auto", replace(WORKING, torch=Torch("2.13.0+cpu")))
    assert no_cuda.why == "CPU: torch 2.13.0+cpu, built without CUDA"
    assert choose("auto", Facts()).why == "CPU: no GPU found"
    assert "minutes" in choose("cuda", replace(NO_TRITON, gsplat=Gsplat("1.5.3"))).why
    assert "doctor --compile" in choose("auto", replace(NO_TRITON, gsplat=Gsplat("1.5.3"))).why
    no_way = choose("auto", replace(WORKING, gsplat=Gsplat(), triton=Triton()))
    assert no_way.why == "CPU: the GPU is ready, but Triton: not installed; see `endoprior doctor`"


def test_json_of_a_machine(capsys, monkeypatch):
    monkeypatch.setattr("endoprior.doctor.read_facts", lambda: WORKING)
    assert main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found) == {
        "version", "verdict", "device", "backend", "why", "cuda_works", "backends", "only_to_compile", "compiling",
        "blocking", "next_step", "lines", "facts",
    }  # fmt: skip
    assert all(set(line) == {"part", "name", "state", "found", "fix"} for line in found["lines"])
    names = [line["name"] for line in found["lines"] if line["part"] in ("cuda", "triton", "gsplat")]
    assert names == [
        "system", "GPU", "driver", "torch", "CUDA in torch", "GPU computes", "C compiler", "Python headers", "Triton",
        "gsplat", "nvcc", "CUDA headers", "CUDA library", "C++ compiler", "ninja", "gsplat compiled",
    ]  # fmt: skip
    assert set(found["facts"]) == {
        "system", "driver", "torch", "triton", "gsplat", "toolkit", "builders", "packages",
        "weights", "weights_error", "variables",
    }  # fmt: skip
    assert (found["device"] == "cuda") == found["cuda_works"] == any(found["backends"].values())
    assert found["next_step"]


def test_our_variables_are_shown_and_typing_errors_are_found():
    variables = {"ENDOPRIOR_WEIGTHS": "w", "ENDOPRIOR_CACHE_GB": "much", "ENDOPRIOR_WEIGHTS": "w", "CC": "gcc-12"}
    lines = {line.name: line for line in examine(replace(WORKING, variables=variables)).lines}
    states = {name: lines[name].state for name in variables}
    assert states == {
        "ENDOPRIOR_WEIGTHS": "wrong", "ENDOPRIOR_CACHE_GB": "wrong", "ENDOPRIOR_WEIGHTS": "ok", "CC": "ok",
    }  # fmt: skip
    assert lines["ENDOPRIOR_WEIGTHS"].fix == "unset ENDOPRIOR_WEIGTHS"
