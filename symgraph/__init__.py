"""symgraph plans tasks that form a directed graph: skills to choose, chance, uncertainty, continuous actions."""

from symgraph import learned
from symgraph.codegen.cplanner import CPlanner
from symgraph.codegen.export import export_c
from symgraph.errors import (
    CompileError,
    GraphError,
    InputError,
    MissingExtraError,
    SlotError,
    SolveError,
    StorageError,
    SymgraphError,
)
from symgraph.graph import Graph
from symgraph.many import solve_many
from symgraph.model import Model, Parameter, Propagator
from symgraph.objective import Objective
from symgraph.optimizers import Adadelta, Bonmin, Enumerate, Ipopt, Lbfgs
from symgraph.plan import Plan
from symgraph.plan_table import PlanRow, PlanTable
from symgraph.planner import solve
from symgraph.plots import plot_map, plot_runs, plot_value
from symgraph.slots import Action, Gaussian, Selection, State
from symgraph.tree import Tree, unroll

__all__ = [
    "Action",
    "Adadelta",
    "Bonmin",
    "CPlanner",
    "CompileError",
    "Enumerate",
    "Gaussian",
    "Graph",
    "GraphError",
    "InputError",
    "Ipopt",
    "Lbfgs",
    "MissingExtraError",
    "Model",
    "Objective",
    "Parameter",
    "Plan",
    "PlanRow",
    "PlanTable",
    "Propagator",
    "Selection",
    "SlotError",
    "SolveError",
    "State",
    "StorageError",
    "SymgraphError",
    "Tree",
    "export_c",
    "learned",
    "plot_map",
    "plot_runs",
    "plot_value",
    "solve",
    "solve_many",
    "unroll",
]


def __getattr__(name: str) -> str:
    if name == "__version__":
        from importlib.metadata import version

        return version("symgraph")
    raise AttributeError(f"module 'symgraph' has no attribute {name!r}")
