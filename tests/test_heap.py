"""Memory that is freed is used again without the system clearing its pages anew."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

CODE = """
import resource, sys
import numpy as np
from endoprior.system.heap import keep_freed_memory

def faults_of_an_array():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(2**24, np.float32)  # 64 MB: 16,384 pages
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

if sys.argv[1] == "keep":
    keep_freed_memory()
print(faults_of_an_array(), faults_of_an_array())
"""


def faults(word: str) -> list[int]:
    """Page faults of two equal arrays, one after the other, in a process of its own."""
    done = subprocess.run([sys.executable, "-c", CODE, word], capture_output=True, text=True, check=True)
    return [int(number) for number in done.stdout.split()]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the settings are those of the GNU C library")
def test_freed_memory_is_used_again():
    first, second = faults("keep")
    assert second < first / 10, "the second array should lie where the first one was"


def test_elsewhere_nothing_happens(monkeypatch):
    from endoprior.system import heap

    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(heap.ctypes, "CDLL", lambda name: pytest.fail("no library is asked"))
    heap.keep_freed_memory()


def test_a_library_without_the_setting_is_left_alone(monkeypatch):
    from endoprior.system import heap

    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(heap.ctypes, "CDLL", lambda name: object())
    heap.keep_freed_memory()
