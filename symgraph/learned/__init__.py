"""Learned models: networks that predict how sure they are, fitted to samples and planned with as they are."""

from symgraph.learned.branches import BranchNetwork, BranchReport
from symgraph.learned.calibration import Calibration, PitHistogram, Scores, calibrate
from symgraph.learned.episodes import Episode, EpisodeStore, Visit
from symgraph.learned.loop import OnlineLoop
from symgraph.learned.network import FitReport, StochasticNetwork
from symgraph.learned.report import EpisodeReport
from symgraph.learned.schedule import Exploration, Stage, World
from symgraph.learned.torch_modules.model import TorchModel, from_torch

__all__ = [
    "BranchNetwork",
    "BranchReport",
    "Calibration",
    "Episode",
    "EpisodeReport",
    "EpisodeStore",
    "Exploration",
    "FitReport",
    "OnlineLoop",
    "PitHistogram",
    "Scores",
    "Stage",
    "StochasticNetwork",
    "TorchModel",
    "Visit",
    "World",
    "calibrate",
    "from_torch",
]
