"""Decide from facts what works and what to do next. Pure: nothing here looks at the machine.

CUDA is a chain: each link needs those before it, and the first that is not right is the one next step.
"""

from __future__ import annotations

from dataclasses import dataclass

from . import mend
from .lines import Line, State
from .optional import machine_lines, optional_lines
from .records import Facts, Gpu, number

NOTHING = "nothing"


@dataclass(frozen=True)
class Report:
    """Every line, and what follows for CUDA."""

    lines: tuple[Line, ...]
    works: bool
    """Whether every link of the chain is right."""
    blocking: Line | None
    """The first link that is not; None if `works`."""
    only_to_compile: bool
    """Whether all that is left is that gsplat compiles itself, which it does at its first use."""

    @property
    def next_step(self) -> str:
        """The one thing to do next."""
        if self.blocking is None:
            return f"{NOTHING}: CUDA works"
        return self.blocking.mend or f"{NOTHING} to install: {self.blocking.found}"


def examine(facts: Facts) -> Report:
    """Judge a machine."""
    chain = cuda_lines(facts)
    blocking = next((line for line in chain if line.state != "ok"), None)
    only_to_compile = blocking is not None and blocking is chain[-1] and blocking.state == "missing"
    lines = (*machine_lines(facts), *chain, *optional_lines(facts))
    return Report(lines, blocking is None, blocking, only_to_compile)


def cuda_lines(facts: Facts) -> list[Line]:
    """The chain, in the order in which things must be right."""
    links = [_system, _gpu, _driver, _torch, _available, _computes, _gsplat]
    chain = [link(facts) for link in links]
    if facts.gsplat.prebuilt and facts.gsplat.loads:
        names = ("nvcc", "CUDA headers", "C++ compiler", "Python headers", "ninja")
        chain += [_line(name, "ok", "not needed: gsplat came compiled") for name in names]
    else:
        chain += [link(facts) for link in (_nvcc, _headers, _compiler, _python_headers, _ninja)]
    chain.append(_compiled(facts))
    hopeless = any(line.state != "ok" and not line.mend for line in chain[:2])
    if not hopeless:
        return chain
    # What comes after is of no use here: it is not wrong to be without it, and nothing mends it.
    plain = [_line(line.name, line.state, line.found) for line in chain[:2]]
    return plain + [_line(line.name, "ok" if line.state == "ok" else "missing", line.found) for line in chain[2:]]


def _line(name: str, state: State, found: str, mend_: str = "") -> Line:
    return Line("cuda", name, state, found, mend_)


def _system(facts: Facts) -> Line:
    words = f"{facts.system.name} {facts.system.machine}"
    if facts.system.name in ("Linux", "Windows"):
        return _line("system", "ok", words)
    return _line("system", "wrong", f"{words}: there is no CUDA for it; the CPU does everything")


def _gpu(facts: Facts) -> Line:
    driver, gpus = facts.driver, facts.torch.gpus or facts.driver.gpus
    blind = driver.on_bus is None and driver.tool  # the bus cannot be seen, but somebody installed NVIDIA's tool
    if not (gpus or driver.on_bus or driver.module or driver.device_files or driver.version or blind):
        inside = " in this container (--gpus all shows it those of the host)" * facts.system.container
        return _line("GPU", "missing", f"no NVIDIA GPU is seen{inside}; the CPU does everything")
    if not gpus:
        return _line("GPU", "ok", f"{driver.on_bus} on the bus" if driver.on_bus else "one, by its driver")
    words = ", ".join(map(_gpu_words, gpus))
    if gpus[0].capability and gpus[0].capability < mend.LEAST_CAPABILITY:
        return _line("GPU", "wrong", f"{words}: gsplat needs compute capability 7.0", _other_gpu(facts))
    return _line("GPU", "ok", words)


def _driver(facts: Facts) -> Line:
    driver, system = facts.driver, facts.system
    words = f"{driver.version or driver.module or 'version unknown'}, serves CUDA {driver.cuda or 'of unknown version'}"
    if facts.torch.available:
        return _line("driver", "ok", words)
    if driver.error and not (driver.module or driver.device_files) and driver.on_bus is not None:
        return _line("driver", "missing", f"not loaded; {driver.error}", mend.install_driver(facts))
    if driver.error:
        return _line("driver", "wrong", driver.error, _restart(facts))
    if not (driver.module or driver.device_files or driver.version or driver.tool):
        return _line("driver", "missing", "no sign of it", mend.install_driver(facts))
    if driver.module and not driver.device_files:
        found = f"{driver.module} is loaded, but /dev/nvidia* is not there"
        if system.container:
            return _line("driver", "wrong", found, "start the container with --gpus all")
        return _line("driver", "wrong", found, "sudo nvidia-modprobe -u -c=0")
    card = mend.capability(facts)
    if driver.cuda and not mend.torch_builds(facts) and (card is None or card >= mend.LEAST_CAPABILITY):
        return _line("driver", "wrong", f"{words}: too old for this GPU and Python", mend.install_driver(facts))
    return _line("driver", "ok", words)


def _torch(facts: Facts) -> Line:
    torch = facts.torch
    install = mend.install_torch(facts) or mend.install_driver(facts)
    repair = mend.install_torch(facts, again=True) or mend.install_driver(facts)
    if not torch.version:
        return _line("torch", "missing", "not installed", install)
    if torch.error:
        hangs = "no answer" in torch.error  # most likely in the driver
        return _line("torch", "wrong", f"{torch.version}: {torch.error}", _restart(facts) if hangs else repair)
    if torch.hip:
        return _line("torch", "wrong", f"{torch.version}, built for ROCm, which gsplat does not serve", install)
    if not torch.cuda:
        return _line("torch", "wrong", f"{torch.version}, built without CUDA", install)
    words = f"{torch.version}, built for CUDA {torch.cuda}"
    if number(torch.version) < mend.LEAST_TORCH:
        return _line("torch", "wrong", f"{words}; 2.4 or newer is needed", repair)
    if not torch.available and facts.driver.cuda and number(torch.cuda)[:1] > number(facts.driver.cuda)[:1]:
        return _line("torch", "wrong", f"{words}; the driver serves only {facts.driver.cuda}", install)
    return _line("torch", "ok", words)


def _available(facts: Facts) -> Line:
    torch, name = facts.torch, "CUDA in torch"
    if torch.available:
        return _line(name, "ok", f"available, {len(torch.gpus)} GPU{'s' * (len(torch.gpus) != 1)}")
    if torch.available is None:
        return _line(name, "missing", "not tried", "endoprior doctor" if torch.cuda and not torch.error else "")
    found = torch.reason or "not available"
    if "CUDA_VISIBLE_DEVICES" in facts.variables:
        masked = f"{found}; CUDA_VISIBLE_DEVICES is {facts.variables['CUDA_VISIBLE_DEVICES']!r}"
        return _line(name, "wrong", masked, mend.unset_variable(facts, "CUDA_VISIBLE_DEVICES"))
    return _line(name, "wrong", found, _restart(facts))


def _computes(facts: Facts) -> Line:
    gpus, name = facts.torch.gpus, "GPU computes"
    if not gpus:
        return _line(name, "missing", "not tried", _restart(facts) if facts.torch.available else "")
    gpu = gpus[0]
    if gpu.computes:
        return _line(name, "ok", f"{gpu.name} adds two numbers")
    found = f"{gpu.name}: {gpu.error or 'it adds two numbers wrongly'}"
    if other := _other_gpu(facts):
        return _line(name, "wrong", found, other)
    if "out of memory" in gpu.error:
        return _line(name, "wrong", found, "end what fills the GPU: nvidia-smi shows it")
    if "kernel image" in gpu.error:
        return _line(name, "wrong", found, mend.install_torch(facts) or mend.install_driver(facts))
    return _line(name, "wrong", found, _restart(facts))


def _gsplat(facts: Facts) -> Line:
    version = facts.gsplat.version
    if not version:
        return _line("gsplat", "missing", "not installed", "pip install 'endoprior[cuda]'")
    if number(version) and number(version) < mend.LEAST_GSPLAT:
        return _line("gsplat", "wrong", f"{version}; 1.5.3 or newer is needed", "pip install --upgrade 'gsplat>=1.5.3'")
    return _line("gsplat", "ok", version)


def _nvcc(facts: Facts) -> Line:
    toolkit, wanted = facts.toolkit, number(mend.planned_cuda(facts))
    if not toolkit.nvcc:
        named = toolkit.home_from in ("CUDA_HOME", "CUDA_PATH")
        repair = mend.install_toolkit(facts) if mend.fitting_toolkit(facts) or not named else ""
        found = toolkit.error or "no CUDA toolkit"
        found += f" ({toolkit.home_from} says so)" * named
        return _line(
            "nvcc", "wrong" if named else "missing", found, repair or mend.unset_variable(facts, toolkit.home_from)
        )
    words = f"{toolkit.nvcc} in {toolkit.home}"
    if wanted and number(toolkit.nvcc)[:1] != wanted[:1]:
        fitting = mend.fitting_toolkit(facts)
        usable = mend.knows_card(facts, toolkit.nvcc) and number(toolkit.nvcc) >= (12,)  # 11 would mean an old torch
        other_torch = mend.install_torch(facts, number(toolkit.nvcc)[0]) if usable else ""
        repair = mend.install_toolkit(facts) if fitting or not other_torch else other_torch
        return _line("nvcc", "wrong", f"{words}; torch needs CUDA {mend.planned_cuda(facts)}", repair)
    if not mend.knows_card(facts, toolkit.nvcc):
        return _line("nvcc", "wrong", f"{words}; it does not know this GPU", mend.install_toolkit(facts))
    return _line("nvcc", "ok", words)


def _headers(facts: Facts) -> Line:
    toolkit, name = facts.toolkit, "CUDA headers"
    if toolkit.headers:
        return _line(name, "ok", "cuda_runtime.h")
    found = f"no cuda_runtime.h in {toolkit.home}/include" if toolkit.home else "no CUDA toolkit"
    if toolkit.headers_elsewhere:
        return _line(name, "wrong", found, mend.set_variable(facts, "CUDA_INC_PATH", toolkit.headers_elsewhere))
    return _line(name, "missing", found, mend.install_toolkit(facts))


def _compiler(facts: Facts) -> Line:
    builders, name = facts.builders, "C++ compiler"
    if not builders.compiler_version:
        return _line(name, "missing", builders.compiler_error or "none", mend.install_compiler(facts))
    words = f"{builders.compiler} {builders.compiler_version}"
    bound = facts.torch.host_compilers.get(facts.toolkit.nvcc, [])
    if builders.compiler_is_gcc and bound and number(builders.compiler_version) >= tuple(bound):
        found = f"{words}: too new for nvcc {facts.toolkit.nvcc}"
        return _line(name, "wrong", found, mend.older_compiler(facts, bound[0]))
    return _line(name, "ok", words)


def _python_headers(facts: Facts) -> Line:
    if facts.builders.python_headers:
        return _line("Python headers", "ok", "Python.h")
    return _line("Python headers", "missing", "no Python.h", mend.install_python_headers(facts))


def _ninja(facts: Facts) -> Line:
    builders = facts.builders
    if builders.ninja:
        return _line("ninja", "ok", builders.ninja)
    if builders.ninja_beside_python:
        return _line("ninja", "wrong", f"in {builders.ninja_beside_python}, not on PATH", mend.use_ninja(facts))
    return _line("ninja", "missing", "not on PATH", mend.use_ninja(facts))


def _compiled(facts: Facts) -> Line:
    gsplat, name = facts.gsplat, "gsplat compiled"
    if gsplat.loads:
        how = "came compiled" if gsplat.prebuilt else "compiled on this machine"
        took = f", ready in {gsplat.compile_seconds:.0f} s" if gsplat.compile_seconds is not None else ""
        return _line(name, "ok", how + took)
    if gsplat.loads is None:
        found = "not tried" if gsplat.prebuilt or gsplat.cached else "not yet; takes minutes, once"
        return _line(name, "missing", found, mend.compile_again(facts))
    if gsplat.cached:
        return _line(name, "wrong", f"what was compiled does not work: {gsplat.error}", mend.compile_again(facts))
    if gsplat.prebuilt:
        return _line(name, "missing", f"it came compiled for another torch: {gsplat.error}", mend.compile_again(facts))
    return _line(name, "wrong", gsplat.error, 'VERBOSE=1 python -c "import gsplat.cuda._backend"')


def _gpu_words(gpu: Gpu) -> str:
    """A card in words."""
    words = [gpu.name]
    words += [f"compute capability {gpu.capability[0]}.{gpu.capability[1]}"] if gpu.capability else []
    words += [f"{gpu.memory_gb:.0f} GB"] if gpu.memory_gb else []
    return f"{words[0]} ({', '.join(words[1:])})" if words[1:] else words[0]


def _other_gpu(facts: Facts) -> str:
    """The command that makes another card, one that computes and is new enough, the first; "" if there is none."""
    for index, gpu in enumerate(facts.torch.gpus):
        if index and gpu.computes and (gpu.capability or (0, 0)) >= mend.LEAST_CAPABILITY:
            names = facts.variables.get("CUDA_VISIBLE_DEVICES", "").split(",")
            name = names[index].strip() if index < len(names) else str(index)
            return mend.set_variable(facts, "CUDA_VISIBLE_DEVICES", name)
    return ""


def _restart(facts: Facts) -> str:
    if facts.system.name == "Windows":
        return "restart the computer; if that does not help, install NVIDIA's driver again"
    if facts.system.container:
        return "start the container again with --gpus all; if that does not help, restart the host"
    return "sudo reboot"
