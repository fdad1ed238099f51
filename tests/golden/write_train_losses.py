"""Write `train_losses.json`: the objective and the number of Gaussians over twenty steps, for each deformation.

Run after a deliberate change of the method, look at the difference, and say in the commit why it changed.
"""

import json
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from conftest import write_tiny_sequence  # noqa: E402 - the tests' folder is not a package
from tiny_training import KINDS, losses_of, tiny_config  # noqa: E402

with tempfile.TemporaryDirectory() as folder:
    data = write_tiny_sequence(Path(folder) / "tiny")
    rows = {kind: losses_of(data, tiny_config(kind)) for kind in KINDS}
(HERE / "train_losses.json").write_text(json.dumps(rows, indent=1) + "\n")
