"""NVIDIA's driver: its files, which are quick to read, and nvidia-smi, which may hang."""

from __future__ import annotations

import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

from .probe_process import clean, run_program
from .records import Driver, Gpu, number

LIMIT_S = 10.0
"""Longest wait for nvidia-smi, s: it wakes sleeping GPUs first, which takes seconds each."""
DRIVER_CUDA = {
    450: "11.0", 455: "11.1", 460: "11.2", 465: "11.3", 470: "11.4", 495: "11.5", 510: "11.6", 515: "11.7",
    520: "11.8", 525: "12.0", 530: "12.1", 535: "12.2", 545: "12.3", 550: "12.4", 555: "12.5", 560: "12.6",
    565: "12.7", 570: "12.8", 575: "12.9", 580: "13.0", 590: "13.1", 595: "13.2",
}  # fmt: skip
"""First driver branch that serves each CUDA: NVIDIA's release notes of the toolkit."""
DEVICE_FILES = ("/dev/nvidia0", "/dev/nvidiactl", "/dev/nvhost-gpu")
"""How a program reaches a GPU: on Linux, in a container that has some of the GPUs, on a Jetson."""
WSL_DEVICE = "/dev/dxg"
"""In WSL, for GPUs of any maker: one is NVIDIA's only if NVIDIA's tool is there too."""
TOOL_PLACES = ("/usr/lib/wsl/lib/nvidia-smi", "/opt/bin/nvidia-smi")
"""Where nvidia-smi is when it is not on PATH."""


def driver_files(root: Path = Path("/")) -> Driver:
    """What its files tell, without running anything.

    Args:
        root: where the file system starts; tests put another one here.
    """
    tool = shutil.which("nvidia-smi") or next((place for place in TOOL_PLACES if os.access(place, os.X_OK)), "")
    return Driver(
        on_bus=_on_bus(root / "sys/bus/pci/devices"),
        module=_module(root / "proc/driver/nvidia/version"),
        device_files=any((root / name[1:]).exists() for name in (*DEVICE_FILES, *[WSL_DEVICE] * bool(tool))),
        tool=tool,
    )


def driver_answers(driver: Driver, limit_s: float = LIMIT_S) -> Driver:
    """The driver with what nvidia-smi prints, if there is one."""
    if not driver.tool:
        return replace(driver, version=driver.module, cuda=_served(driver.module))
    answer = run_program([driver.tool], limit_s)
    if answer.problem:
        error = f"{answer.problem}: {clean(answer.text)}" if answer.text.strip() else answer.problem
        return replace(driver, version=driver.module, cuda=_served(driver.module), error=error)
    version, cuda = read_banner(answer.text)
    if not version:
        error = f"{Path(driver.tool).name} printed no version: {clean(answer.text, 80)}"
        return replace(driver, version=driver.module, cuda=_served(driver.module), error=error)
    query = "--query-gpu=name,compute_cap,memory.total"
    listed = run_program([driver.tool, query, "--format=csv,noheader,nounits"], limit_s)
    gpus = () if listed.problem else read_gpus(listed.text)
    return replace(driver, version=version, cuda=cuda or _served(version), gpus=gpus)


def read_banner(text: str) -> tuple[str, str]:
    """Version of the driver and of the CUDA it serves, out of nvidia-smi's banner; "" for what it does not say.

    Since 610 they are called "KMD Version" and "CUDA UMD Version".
    """
    version = re.search(r"(?:Driver|KMD) Version\s*:\s*(\d+(?:\.\d+)+)", text)
    cuda = re.search(r"CUDA (?:UMD )?Version\s*:\s*(\d+\.\d+)", text)
    return version[1] if version else "", cuda[1] if cuda else ""


def read_gpus(text: str) -> tuple[Gpu, ...]:
    """GPUs out of nvidia-smi's table of name, compute capability and memory in MiB; lines that do not fit are skipped.

    A name may hold a comma.
    """
    found = []
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.rsplit(",", 2)]
        if len(cells) != 3 or not cells[0]:
            continue
        capability = re.fullmatch(r"(\d{1,3})\.(\d{1,3})", cells[1])
        memory = re.fullmatch(r"\d{1,9}", cells[2])
        if capability or memory:  # one of them may be "[N/A]"
            pair = (int(capability[1]), int(capability[2])) if capability else None
            found.append(Gpu(clean(cells[0], 60), pair, int(memory[0]) / 1024 if memory else None))
    return tuple(found)


def _served(version: str) -> str:
    """The CUDA a driver of this version serves, "" if that is not known."""
    branch = number(version)[:1]
    known = [least for least in DRIVER_CUDA if branch and least <= branch[0]]
    return DRIVER_CUDA[max(known)] if known else ""


def _module(file: Path) -> str:
    """Version of the kernel module that is loaded, "?" if it does not say, "" if there is none."""
    try:
        text = file.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    found = re.search(r"Kernel Module\b.*?\s(\d+(?:\.\d+)+)", text)
    return found[1] if found else "?"


def _on_bus(folder: Path) -> int | None:
    """Number of NVIDIA's display controllers (PCI vendor 10de, class 03) on the bus; None if it cannot be read."""
    try:
        devices = list(folder.iterdir())
    except OSError:
        return None
    count = 0
    for device in devices:
        try:
            vendor, kind = ((device / name).read_text("utf-8", "replace").strip() for name in ("vendor", "class"))
        except OSError:
            continue
        count += vendor == "0x10de" and kind.startswith("0x03")
    return count
