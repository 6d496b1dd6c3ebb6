"""Draw the pictures of the README and the guide: `python docs/images/draw.py` from the repository's root."""

from pathlib import Path

import symgraph as sg
from models import cannon

HERE = Path(__file__).parent

objective = sg.Objective(sg.unroll(cannon.graph()))
plan = sg.solve(objective, cannon.state(1.3))
plan.diagram().save(HERE / "cannon_tree.svg")
cannon.graph().diagram().save(HERE / "cannon_graph.svg")
