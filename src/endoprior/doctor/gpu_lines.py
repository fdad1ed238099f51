"""The lines about the GPU itself, its driver and torch, which both GPU backends need."""

from __future__ import annotations

from . import fixes
from .lines import Line, State
from .records import Facts, Gpu, number


def gpu_lines(facts: Facts) -> tuple[Line, ...]:
    """In the order in which they must be ok."""
    return tuple(link(facts) for link in (_system, _gpu, _driver, _torch, _available, _computes))


def _line(name: str, state: State, found: str, fix: str = "") -> Line:
    return Line("cuda", name, state, found, fix)


def _system(facts: Facts) -> Line:
    words = f"{facts.system.name} {facts.system.machine}"
    if facts.system.name in ("Linux", "Windows"):
        return _line("system", "ok", words)
    return _line("system", "wrong", f"{words}: CUDA does not support it")


def _gpu(facts: Facts) -> Line:
    driver, gpus = facts.driver, facts.torch.gpus or facts.driver.gpus
    blind = driver.on_bus is None and driver.tool  # the bus cannot be read, but NVIDIA's tool is installed
    if not (gpus or driver.on_bus or driver.module or driver.device_files or driver.version or blind):
        return _line("GPU", "missing", "none found")
    if not gpus:
        return _line("GPU", "ok", f"{driver.on_bus} on the bus" if driver.on_bus else "one, by its driver")
    words = ", ".join(map(_gpu_words, gpus))
    if gpus[0].capability and gpus[0].capability < fixes.LEAST_CAPABILITY:
        return _line("GPU", "wrong", f"{words}: compute capability 7.0 is needed", _other_gpu(facts))
    return _line("GPU", "ok", words)


def _driver(facts: Facts) -> Line:
    driver, system = facts.driver, facts.system
    version = driver.version or driver.module or "version unknown"
    words = f"{version}, supports CUDA {driver.cuda or 'of unknown version'}"
    if facts.torch.available:
        return _line("driver", "ok", words)
    if driver.error and not (driver.module or driver.device_files) and driver.on_bus is not None:
        return _line("driver", "missing", f"not loaded; {driver.error}", fixes.install_driver(facts))
    if driver.error:
        return _line("driver", "wrong", driver.error, _restart(facts))
    if not (driver.module or driver.device_files or driver.version or driver.tool):
        return _line("driver", "missing", "not found", fixes.install_driver(facts))
    if driver.module and not driver.device_files:
        found = f"{driver.module} is loaded, but /dev/nvidia* is not there"
        if system.container:
            return _line("driver", "wrong", found, "start the container with --gpus all")
        return _line("driver", "wrong", found, "sudo nvidia-modprobe -u -c=0")
    arch = fixes.capability(facts)
    if driver.cuda and not fixes.torch_builds(facts) and (arch is None or arch >= fixes.LEAST_CAPABILITY):
        return _line("driver", "wrong", f"{words}: too old for this GPU and Python", fixes.install_driver(facts))
    return _line("driver", "ok", words)


def _torch(facts: Facts) -> Line:
    torch = facts.torch
    install = fixes.install_torch(facts) or fixes.install_driver(facts)
    repair = fixes.install_torch(facts, again=True) or fixes.install_driver(facts)
    if not torch.version:
        return _line("torch", "missing", "not installed", install)
    if torch.error:
        hangs = "no answer" in torch.error  # most likely in the driver
        return _line("torch", "wrong", f"{torch.version}: {torch.error}", _restart(facts) if hangs else repair)
    if torch.hip:
        return _line("torch", "wrong", f"{torch.version}, built for ROCm; only NVIDIA GPUs are supported", install)
    if not torch.cuda:
        return _line("torch", "wrong", f"{torch.version}, built without CUDA", install)
    words = f"{torch.version}, built for CUDA {torch.cuda}"
    if number(torch.version) < fixes.LEAST_TORCH:
        return _line("torch", "wrong", f"{words}; 2.4 or newer is needed", repair)
    if not torch.available and facts.driver.cuda and number(torch.cuda)[:1] > number(facts.driver.cuda)[:1]:
        return _line("torch", "wrong", f"{words}; the driver supports only {facts.driver.cuda}", install)
    return _line("torch", "ok", words)


def _available(facts: Facts) -> Line:
    torch, name = facts.torch, "CUDA in torch"
    if torch.available:
        return _line(name, "ok", f"available, {len(torch.gpus)} GPU{'s' * (len(torch.gpus) != 1)}")
    if torch.available is None:
        return _line(name, "missing", "not tried", "endoprior doctor" if torch.cuda and not torch.error else "")
    found = torch.reason.split(". ")[0] or "not available"  # without the advice that torch adds
    if "CUDA_VISIBLE_DEVICES" in facts.variables:
        masked = f"{found}; CUDA_VISIBLE_DEVICES is {facts.variables['CUDA_VISIBLE_DEVICES']!r}"
        return _line(name, "wrong", masked, fixes.unset_variable(facts, "CUDA_VISIBLE_DEVICES"))
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
        return _line(name, "wrong", found, "free its memory: nvidia-smi shows which programs use it")
    if "kernel image" in gpu.error:
        return _line(name, "wrong", found, fixes.install_torch(facts) or fixes.install_driver(facts))
    return _line(name, "wrong", found, _restart(facts))


def _gpu_words(gpu: Gpu) -> str:
    """A GPU in words."""
    words = [gpu.name]
    words += [f"compute capability {gpu.capability[0]}.{gpu.capability[1]}"] if gpu.capability else []
    words += [f"{gpu.memory_gb:.0f} GB"] if gpu.memory_gb else []
    return f"{words[0]} ({', '.join(words[1:])})" if words[1:] else words[0]


def _other_gpu(facts: Facts) -> str:
    """The command that selects another GPU, one that computes and is new enough; "" if there is none."""
    for index, gpu in enumerate(facts.torch.gpus):
        if index and gpu.computes and (gpu.capability or (0, 0)) >= fixes.LEAST_CAPABILITY:
            names = facts.variables.get("CUDA_VISIBLE_DEVICES", "").split(",")
            name = names[index].strip() if index < len(names) else str(index)
            return fixes.set_variable(facts, "CUDA_VISIBLE_DEVICES", name)
    return ""


def _restart(facts: Facts) -> str:
    if facts.system.name == "Windows":
        return "restart the computer; if that does not help, install NVIDIA's driver again"
    if facts.system.container:
        return "start the container again with --gpus all; if that does not help, restart the host"
    return "sudo reboot"
