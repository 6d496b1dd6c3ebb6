"""Ways to find good actions and selections, one a file, behind one small abstract class."""

from symgraph.optimizers.adadelta import Adadelta
from symgraph.optimizers.bonmin import Bonmin
from symgraph.optimizers.enumerate import Enumerate
from symgraph.optimizers.ipopt import Ipopt
from symgraph.optimizers.lbfgs import Lbfgs
from symgraph.optimizers.problem import Optimizer, Problem, Run, Search

__all__ = ["Adadelta", "Bonmin", "Enumerate", "Ipopt", "Lbfgs", "Optimizer", "Problem", "Run", "Search"]
