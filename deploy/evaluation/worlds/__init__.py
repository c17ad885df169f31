"""Worlds without number: floor plans of many kinds with ground truth, walks and depth, made from a seed."""

from prior_sg.deploy.evaluation.worlds.kinds import KINDS
from prior_sg.deploy.evaluation.worlds.world import View, World, views_of, world_of

__all__ = ["KINDS", "View", "World", "views_of", "world_of"]
