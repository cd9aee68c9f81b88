"""Paths on a map of the floor: clearance, A*, and smoothing that keeps clear."""

from torchvo360.planning.config import PlanConfig
from torchvo360.planning.costs import Clearance, clearance_of
from torchvo360.planning.plan import Plan, Reason, plan_path
from torchvo360.planning.search import Search, find_path

__all__ = ["Clearance", "Plan", "PlanConfig", "Reason", "Search", "clearance_of", "find_path", "plan_path"]
