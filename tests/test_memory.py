"""Memory: what is free, a cache that keeps to its size, and memory that training frees."""

from __future__ import annotations

import json
import os
import platform
import resource
import subprocess
import sys

import numpy as np
import pytest

from endoprior.data import load_sequence
from endoprior.runs.train import train
from endoprior.system import memory
from endoprior.system.memory import MIN_CACHE, BoundedCache, available_bytes, cache_bytes, freed_memory_kept


def test_free_memory_is_between_zero_and_total():
    assert 0 < available_bytes() <= os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def test_a_limit_of_the_process_counts():
    code = "from endoprior.system.memory import available_bytes; print(available_bytes())"
    limit = 2 * 2**30

    def limited():
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))

    told = subprocess.run([sys.executable, "-c", code], preexec_fn=limited, capture_output=True, text=True, check=True)
    assert 0 < int(told.stdout) < limit


@pytest.mark.parametrize(
    ("limit", "used", "parts", "name"),
    [
        ("memory.max", "memory.current", "memory.stat", "inactive_file"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat", "total_inactive_file"),
    ],
)
def test_cached_files_of_a_container_count_as_free(tmp_path, monkeypatch, limit, used, parts, name):
    monkeypatch.setattr(memory, "CONTROL_GROUP", tmp_path)
    (tmp_path / "memory").mkdir()
    for file, text in ((limit, "90000000"), (used, "89000000"), (parts, f"anon 1000\n{name} 50000000")):
        (tmp_path / file).write_text(text + "\n")
    assert available_bytes() == 51_000_000
    (tmp_path / parts).write_text("not what is expected\n")  # the limit holds all the same
    assert available_bytes() == 1_000_000
    (tmp_path / limit).write_text("max\n")  # no limit
    assert available_bytes() > 51_000_000


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs a system that binds processes to cores")
def test_there_are_no_more_threads_than_cores_that_this_process_may_use():
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        assert memory.workers(1) == 1
    finally:
        os.sched_setaffinity(0, cores)


@pytest.mark.parametrize(
    ("value", "wanted"), [("2", 2_000_000_000), ("0", 0), ("-1", 0), ("lots", None), ("nan", None), ("inf", None)]
)
def test_the_size_of_caches_can_be_set(monkeypatch, value, wanted):
    monkeypatch.setenv("ENDOPRIOR_CACHE_GB", value)
    assert cache_bytes() == wanted if wanted is not None else cache_bytes() >= MIN_CACHE


@pytest.mark.parametrize(("kind", "option"), [(resource.RLIMIT_DATA, "-d"), (resource.RLIMIT_AS, "-v")])
def test_a_limit_too_small_for_the_libraries_is_an_error(kind, option):
    def limited():
        resource.setrlimit(kind, (400 * 2**20, 400 * 2**20))

    words = [sys.executable, "-m", "endoprior", "train", "nowhere", "out"]
    done = subprocess.run(words, preexec_fn=limited, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert f"ulimit {option}: expected at least" in done.stderr and "400 MB" in done.stderr


def test_the_least_recently_used_is_evicted_first():
    made = []
    cache = BoundedCache(30, len)

    def get(key, size):
        return cache.get(key, lambda: made.append(key) or bytes(size))

    for key in "abc":
        get(key, 10)
    get("a", 10)
    get("d", 10)  # the oldest use is that of b
    assert made == ["a", "b", "c", "d"] and len(cache) == 3
    get("a", 10)
    get("b", 10)
    assert made == ["a", "b", "c", "d", "b"]
    assert len(get("large", 100)) == 100 and len(cache) == 1  # the newest stays whatever its size


def test_a_small_cache_changes_speed_and_nothing_else(tiny_sequence, tmp_path, monkeypatch):
    from tiny_training import tiny_config

    files = []
    for size in ("1", "0"):
        monkeypatch.setenv("ENDOPRIOR_CACHE_GB", size)
        sequence = load_sequence(tiny_sequence)
        train(sequence, tiny_config("basis"), tmp_path / size)
        files.append((tmp_path / size / "scene.safetensors").read_bytes())
        assert np.isfinite(sequence.frame(3).depth).all()
    assert files[0] == files[1]


FAULTS = """
import json, resource
from endoprior.system.memory import freed_memory_kept

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
    done = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    first, second = found["kept"]
    assert second < first / 10, "the second array should lie where the first one was"
    assert found["held inside"] - found["held before"] > 50
    assert found["held after"] - found["held before"] < 10
    assert min(found["after"]) > first / 2, "arrays are mapped anew, as before"


@pytest.mark.parametrize(("system", "library"), [("win32", None), ("linux", object())], ids=["windows", "musl"])
def test_elsewhere_nothing_happens(monkeypatch, system, library):
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(memory.ctypes, "CDLL", lambda name: library or pytest.fail("no library is asked"))
    with pytest.raises(ValueError, match="inside"), freed_memory_kept():
        raise ValueError("inside")
