"""Setups: what the situations of an experiment have in common, as arguments of PouringWorld."""

from __future__ import annotations

from typing import Any

from sims.pouring.materials import MATERIALS

# The first three are those of the paper's section VII-B, with an amount of 0.3; "varied" goes beyond it.
SETUPS: dict[str, dict[str, Any]] = {
    "setup1": {"material": "bnc", "mouth": 0.23, "target": 0.3},
    "setup2": {"material": "vsc", "mouth": 0.13, "target": 0.3},
    "general": {"material": list(MATERIALS), "mouth": (0.11, 0.25), "target": 0.3},
    "varied": {
        "material": list(MATERIALS),
        "blend": True,
        "mouth": (0.11, 0.25),
        "target": (0.1, 0.4),
        "receiver_size": ((0.22, 0.38), 0.4, (0.14, 0.22)),
    },
}
