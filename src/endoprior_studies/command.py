"""The command `endoprior bench`, which imports nothing before it runs."""

ABOUT = "compare methods on sequences over seeds, under one protocol"


def run(argv: list[str]) -> int:
    """See `bench.run`."""
    from .bench import run as bench

    return bench(argv)
