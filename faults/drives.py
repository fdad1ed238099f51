"""A network drive that goes away while a command reads or writes: one line that names the error, exit status 2.

`python drives.py WORK` is the process in which files below a folder fail to open.
"""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from harness import ENVIRONMENT, Row, demand, run, small_sequence, training

GONE = ("ESTALE", "ETIMEDOUT", "ENXIO", "EIO", "ENOTCONN")
OPENS_BEFORE = (0, 2, 10, 60)
"""Files that can still be opened before the drive is gone."""
EVENTS = ("open", "os.listdir", "os.scandir")


class Drive:
    """A folder whose files cannot be opened once it is gone. The error names no file, as that of a read does not."""

    def __init__(self, folder: Path) -> None:
        """Watch all that this process opens; there is one drive in a process."""
        self.folder, self.number, self.left, self.hits = str(folder), 0, 0, 0
        sys.addaudithook(self._note)

    def _note(self, event: str, args: tuple) -> None:
        if self.number and event in EVENTS and isinstance(args[0], str | os.PathLike):
            if os.fspath(args[0]).startswith(self.folder):
                self.left -= 1
                if self.left < 0:
                    self.hits += 1
                    raise OSError(self.number, os.strerror(self.number))


def failures(work: Path) -> dict[str, list]:
    from endoprior.cli import main

    drive, out, found = Drive(work / "drive"), work / "drive" / "out", {}
    data, trained = str(work / "drive" / "data"), str(work / "drive" / "run")
    for words in (
        ["check", data, "--out", f"{out}.png"],
        ["prior", data, str(out)],
        [str(word) for word in training(data, out, 20)],
        ["eval", trained, "--no-networks"],
        ["render", trained, str(out)],
        ["export", trained, str(out), "--format", "ply"],
        ["prepare", f"{data}/images", str(out), "--layout", "mono", "--masks", "none", "--depth", "none"],
    ):
        count, wrong = 0, []
        for name in GONE:
            for drive.left in OPENS_BEFORE:
                drive.number, drive.hits, errors = getattr(errno, name), 0, io.StringIO()
                with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
                    try:
                        status = main(words)
                    except Exception as error:
                        status = f"{type(error).__name__}: {error}"
                drive.number = 0
                lines = [line for line in errors.getvalue().splitlines() if line.startswith("endoprior: ")]
                if drive.hits and status != 0:
                    count += 1
                    if status != 2 or len(lines) != 1:
                        wrong.append(f"{name}: {status}")
                shutil.rmtree(out, ignore_errors=True)
        found[words[0]] = [count, wrong]
    return found


def main(work: Path) -> list[Row]:
    data = small_sequence(work / "drive" / "data")
    demand(run(*training(data, work / "drive" / "run", 20)))
    words = [sys.executable, __file__, str(work)]
    told = subprocess.run(words, env=ENVIRONMENT, capture_output=True, encoding="utf-8", check=True).stdout
    return [
        Row("drives", f"gone {count} times during {name}", "; ".join(wrong[:3]) or "one line each", not wrong)
        for name, (count, wrong) in json.loads(told).items()
    ]


if __name__ == "__main__":
    print(json.dumps(failures(Path(sys.argv[1]))))
