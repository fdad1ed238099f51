"""`endoprior view` on the command line: mistakes, and its usual end."""

from __future__ import annotations

import re

from endoprior.cli import main
from endoprior.view.server import Viewer


def test_wrong_input_is_one_line(tmp_path, capsys, tiny_sequence):
    assert main(["view", str(tmp_path / "nothing")]) == 2
    assert main(["view", str(tiny_sequence), "--port", "99999"]) == 2
    assert main(["view", str(tiny_sequence), "--host", "192.0.2.7"]) == 2
    running = tmp_path / "running"
    running.mkdir()
    for name in ("config.json", "log.jsonl"):
        (running / name).write_text("{}")
    assert main(["view", str(running)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 4 and all(line.startswith("endoprior: ") for line in lines)
    assert "endoprior train --resume" in lines[3]


def test_ctrl_c_is_the_usual_way_to_end_the_viewer(tiny_sequence, capsys, monkeypatch):
    def stop(self, wait=0.0):
        raise KeyboardInterrupt

    monkeypatch.setattr(Viewer, "work", stop)
    tokens = set()
    for _ in range(2):
        assert main(["view", str(tiny_sequence), "--port", "0"]) == 0
        printed = capsys.readouterr()
        tokens.add(re.search(r": http://127\.0\.0\.1:\d+/([\w-]{32})/  \(Ctrl-C", printed.out)[1])
    assert len(tokens) == 2 and "encrypted" not in printed.out
    assert printed.out.endswith("viewer closed\n") and "interrupted" not in printed.err
    assert main(["view", str(tiny_sequence), "--port", "0", "--host", "0.0.0.0"]) == 0
    assert "nothing is encrypted" in capsys.readouterr().out.splitlines()[0]
