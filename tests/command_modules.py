"""The commands, as the tests of pages use them."""

from endoprior.cli import REGISTRY
from endoprior.cli.arguments import parse


def parsed(name: str, *words: str) -> object:
    """The arguments of a command, or of `bench masks`; no file that they name is read."""
    if name != "bench":
        return parse(REGISTRY.load(name), words, name)
    from endoprior_studies import bench

    if words[:1] == ("masks",):
        return parse(bench.BenchMasks, words[1:], "bench masks")
    return parse(bench.Bench, words, "bench")
