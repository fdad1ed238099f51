"""How long property-based tests look for a counterexample; test files import it for that effect.

The suite runs the same few examples each time. `ENDOPRIOR_HYPOTHESIS=thorough` draws many new ones.
"""

from __future__ import annotations

import os

from hypothesis import HealthCheck, settings

NAME = os.environ.get("ENDOPRIOR_HYPOTHESIS", "suite")
THOROUGH = NAME == "thorough"

# Fixtures such as folders are safe to share: every example takes a new name. A first example may compile kernels.
_SHARED = {
    "deadline": None,
    "database": None,
    "suppress_health_check": [HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
}
settings.register_profile("suite", max_examples=30, derandomize=True, **_SHARED)
settings.register_profile("thorough", max_examples=300, **_SHARED)
settings.load_profile(NAME)


def examples(count: int) -> settings:
    """Decorator: `count` examples where one is slow or the inputs are few; thorough runs take 10 times as many."""
    return settings(max_examples=10 * count if THOROUGH else count)
