"""Memory that training frees is used again without new pages, and goes back at the end."""

from __future__ import annotations

import json
import platform
import subprocess
import sys

import pytest

from endoprior.system import heap

CODE = """
import json, resource
from endoprior.system.heap import freed_memory_kept

def faults_of_an_array():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    bytearray(b'x') * 2**26  # 64 MB: 16,384 pages
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

def megabytes_held():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 2**20

found = {"before": [faults_of_an_array(), faults_of_an_array()], "held before": megabytes_held()}
with freed_memory_kept():
    found["kept"] = [faults_of_an_array(), faults_of_an_array()]
    found["held inside"] = megabytes_held()
found["held after"] = megabytes_held()
found["after"] = [faults_of_an_array(), faults_of_an_array()]
print(json.dumps(found))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the settings are those of the GNU C library")
def test_freed_memory_is_used_again_and_goes_back():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    first, second = found["kept"]
    assert second < first / 10, "the second array should lie where the first one was"
    assert found["held inside"] - found["held before"] > 50
    assert found["held after"] - found["held before"] < 10
    assert min(found["after"]) > first / 2, "arrays are mapped anew, as before"


@pytest.mark.parametrize(("system", "library"), [("win32", None), ("linux", object())], ids=["windows", "musl"])
def test_elsewhere_nothing_happens(monkeypatch, system, library):
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(heap.ctypes, "CDLL", lambda name: library or pytest.fail("no library is asked"))
    with heap.freed_memory_kept():
        pass


def test_an_error_inside_comes_out():
    with pytest.raises(ValueError, match="inside"), heap.freed_memory_kept():
        raise ValueError("inside")
