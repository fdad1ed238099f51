"""Where weights are looked for, and that nothing else is taken in their place. No test here touches the network."""

from __future__ import annotations

import hashlib
import pickle
import socket
import threading
import time
import urllib.request
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from endoprior.core.checks import InputError
from endoprior.evaluation import networks
from endoprior.evaluation.networks import WeightFiles, WeightsMissing, find_weights, load_weights, select_weights

TOY = WeightFiles("ToyNet", ("toy.safetensors", "toy-0123abcd.pth"), "https://weights.invalid/toy-0123abcd.pth")


@pytest.fixture(autouse=True)
def places(tmp_path, monkeypatch):
    """Empty folders for every place weights may come from, and a network that is down."""
    cache, folder, named = (tmp_path / name for name in ("hub", "folder", "environment"))
    (cache / "checkpoints").mkdir(parents=True)
    folder.mkdir()
    named.mkdir()
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(torch.hub, "_hub_dir", None)
    monkeypatch.setenv(networks.ENVIRONMENT_VARIABLE, str(named))

    def reject(*args, **kwargs):
        raise OSError("the network is down")

    monkeypatch.setattr(urllib.request, "urlopen", reject)
    return {"weights folder": folder, networks.ENVIRONMENT_VARIABLE: named, "torch cache": cache / "checkpoints"}


def test_places_are_tried_in_order(places):
    for source in reversed(places):
        (places[source] / TOY.names[1]).write_bytes(b"")
        found = find_weights(TOY, places["weights folder"])
        assert found == places[source] / TOY.names[1]
    (places["weights folder"] / TOY.names[0]).write_bytes(b"")
    assert find_weights(TOY, places["weights folder"]).name == TOY.names[0]


def test_missing_weights_say_where_they_were_sought_in_one_line(places):
    with pytest.raises(WeightsMissing) as caught:
        find_weights(TOY, places["weights folder"])
    reason = str(caught.value)
    for part in ("ToyNet", *TOY.names, *map(str, places.values()), TOY.url, "the network is down", "--weights-dir"):
        assert part in reason
    assert "\n" not in reason
    with pytest.raises(WeightsMissing, match="downloads are off"):
        find_weights(TOY, download=False)


def test_a_named_folder_that_is_none_is_an_input_error(places, monkeypatch, tmp_path):
    with pytest.raises(InputError, match="--weights-dir: expected a folder"):
        find_weights(TOY, tmp_path / "nowhere")
    monkeypatch.setenv(networks.ENVIRONMENT_VARIABLE, str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match="ENDOPRIOR_WEIGHTS: expected a folder"):
        find_weights(TOY)


@pytest.mark.parametrize("right_hash", [True, False])
def test_download_is_checked_against_its_hash(places, tmp_path, monkeypatch, right_hash):
    monkeypatch.undo()  # the real urlopen, on a file:// address
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.delenv(networks.ENVIRONMENT_VARIABLE, raising=False)
    digest = hashlib.sha256(b"weights").hexdigest()[:8] if right_hash else "00000000"
    origin = tmp_path / f"net-{digest}.pth"
    origin.write_bytes(b"weights")
    files = WeightFiles("ToyNet", ("absent.safetensors",), origin.as_uri())
    target = places["torch cache"] / origin.name
    if right_hash:
        assert find_weights(files) == target
        assert target.read_bytes() == b"weights"
    else:
        with pytest.raises(WeightsMissing, match="invalid hash value"):
            find_weights(files)
        assert not target.exists()
    assert socket.getdefaulttimeout() is None


def test_a_server_that_does_not_answer_costs_no_more_than_the_timeout(monkeypatch):
    monkeypatch.undo()
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.delenv(networks.ENVIRONMENT_VARIABLE, raising=False)
    monkeypatch.setattr(networks, "NETWORK_TIMEOUT_S", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/toy-0123abcd.pth"
        start = time.perf_counter()
        with pytest.raises(WeightsMissing, match=r"timed out|no answer within 0.3 s"):
            find_weights(replace(TOY, url=url))
        assert time.perf_counter() - start < 3  # s; ten timeouts, for a busy machine


def test_a_name_lookup_that_hangs_costs_no_more_than_the_timeout(monkeypatch):
    """Looking up a host obeys no socket timeout, so the wait itself must end."""
    test_is_over = threading.Event()

    def hang(*args, **kwargs):
        test_is_over.wait(20)
        raise OSError("nobody waits for this any more")

    monkeypatch.setattr(urllib.request, "urlopen", hang)
    monkeypatch.setattr(networks, "NETWORK_TIMEOUT_S", 0.3)
    start = time.perf_counter()
    with pytest.raises(WeightsMissing, match=r"no answer within 0.3 s"):
        find_weights(TOY)
    assert time.perf_counter() - start < 3  # s; ten timeouts, for a busy machine
    test_is_over.set()


def test_both_formats_are_read(tmp_path):
    tensors = {"a.weight": torch.arange(6.0).reshape(2, 3)}
    save_file(tensors, tmp_path / "toy.safetensors")
    torch.save(tensors, tmp_path / "toy.pth")
    for name in ("toy.safetensors", "toy.pth"):
        read = load_weights(tmp_path / name)
        assert torch.equal(read["a.weight"], tensors["a.weight"])


class Trap:
    """An object that would write a file if it were unpickled."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.mark.parametrize(
    "kind", ["garbage.safetensors", "garbage.pth", "empty.pth", "trap.pth", "plain_trap.pth", "list.pth"]
)
def test_unreadable_and_dangerous_files_are_rejected(tmp_path, kind):
    path, evidence = tmp_path / kind, tmp_path / "executed"
    if kind == "trap.pth":
        torch.save({"a": Trap(evidence)}, path)
    elif kind == "list.pth":
        torch.save([torch.zeros(2)], path)
    elif kind == "plain_trap.pth":
        path.write_bytes(pickle.dumps(Trap(evidence)))
    else:
        path.write_bytes(b"" if kind == "empty.pth" else b"not weights at all")
    with pytest.raises(WeightsMissing, match=f"{kind}: expected network weights") as caught:
        load_weights(path)
    assert "\n" not in str(caught.value)
    assert not evidence.exists()


def test_names_and_shapes_must_be_those_of_the_network(tmp_path):
    save_file({"a": torch.zeros(2), "unused": torch.zeros(1)}, tmp_path / "toy.safetensors")
    found = tmp_path / "toy.safetensors"
    assert list(select_weights(found, {"net.a": torch.ones(2)}, {"net.a": "a"})) == ["net.a"]
    with pytest.raises(WeightsMissing, match=r"expected a of shape \(3,\), got shape \(2,\)"):
        select_weights(found, {"net.a": torch.ones(3)}, {"net.a": "a"})
    with pytest.raises(WeightsMissing, match=r"expected b of shape \(2,\), got nothing"):
        select_weights(found, {"net.b": torch.ones(2)}, {"net.b": "b"})
