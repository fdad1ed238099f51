"""`python -m endoprior` is the command line."""

import sys

# Without -P, the current folder comes first: import nothing from it from here on.
if not sys.flags.safe_path:
    sys.path.pop(0)

from .cli import main

sys.exit(main())
