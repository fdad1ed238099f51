"""`python -P -m endoprior.system.run_module MODULE ARGUMENTS` runs a module in a process set up as a command is."""

import runpy
import sys

from .surroundings import set_up_process

if __name__ == "__main__":
    set_up_process()
    sys.argv = sys.argv[1:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
