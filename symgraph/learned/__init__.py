"""Learned models: networks that predict how sure they are, fitted to samples and planned with as they are."""

from symgraph.learned.branches import BranchNetwork, BranchReport
from symgraph.learned.calibration import Calibration, PitHistogram, Scores, calibrate
from symgraph.learned.episodes import Episode, EpisodeStore, Visit
from symgraph.learned.network import FitReport, StochasticNetwork

__all__ = [
    "BranchNetwork",
    "BranchReport",
    "Calibration",
    "Episode",
    "EpisodeStore",
    "FitReport",
    "PitHistogram",
    "Scores",
    "StochasticNetwork",
    "Visit",
    "calibrate",
]
