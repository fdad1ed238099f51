#!/bin/sh
# Make .venv and install the program there, in the versions of constraints.txt: `sh tools/install.sh [EXTRA]`.
# The extra `docs` does not change how the program is installed, if it is.
# PYTHON is the Python to use, TORCH_INDEX the package index that torch comes from. uv is used if it is there.
set -eu

stop() {
    echo "endoprior: $1" >&2
    exit 2
}

# What the system's Python lacks, before venv fails in words of its own.
check_python() {
    found=$("$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) ||
        stop "$1: expected Python 3.11 or newer, got none. Fix: Install it, or name it, as in \`make demo PYTHON=python3.12\`."
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
        stop "$1: expected Python 3.11 or newer, got $found. Fix: Install it, then \`make demo PYTHON=python3.12\`."
    "$1" -c 'import ensurepip, venv' 2>/dev/null ||
        stop "$1: expected the modules venv and ensurepip, got none. Fix: \`sudo apt install python$found-venv\` (Debian, Ubuntu)."
}

if command -v uv >/dev/null; then
    # --seed: later, the user installs other packages with pip.
    [ -e .venv/bin/python ] || uv venv --quiet --seed ${PYTHON:+--python "$PYTHON"} .venv
    install() { uv pip install --quiet --python .venv/bin/python --constraint constraints.txt "$@"; }
else
    [ -e .venv/bin/pip ] || { check_python "${PYTHON:-python3}" && "${PYTHON:-python3}" -m venv .venv; }
    install() { .venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt "$@"; }
fi

if [ "${1:-}" = docs ] && .venv/bin/python -c 'import importlib.metadata as m; m.version("endoprior")' 2>/dev/null; then
    packages=$(.venv/bin/python -c 'import tomllib
project = tomllib.load(open("pyproject.toml", "rb"))["project"]
print(*project["optional-dependencies"]["docs"])')
    install $packages # unquoted: one word for each
    exit
fi

# torch comes first, pinned and by itself, so that no other package picks a build of its own.
if [ -n "${TORCH_INDEX:-}" ]; then
    install --no-deps --index-url "$TORCH_INDEX" torch
else
    install torch
fi
# A plain installation (`pip install .`) stays one, unless tests need the checkout.
origin='json.loads(m.distribution("endoprior").read_text("direct_url.json") or "{}")'
editable="import importlib.metadata as m, json; print($origin.get('dir_info', {}).get('editable', False))"
how=$(.venv/bin/python -c "$editable" 2>/dev/null) || how=
if [ "$how" = False ] && [ -z "${1:-}" ]; then
    install .
else
    install --editable ".${1:+[$1]}"
fi
