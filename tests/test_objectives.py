"""Criteria: energy and jerk against differences and what mechanics says, objectives in solves, files and commands."""

from dataclasses import replace

import numpy as np
import pytest
from carts import write
from test_cost import assert_gradients
from trees import random_mechanism_states  # noqa: F401

import planner
from planner import EnergyCost, JerkCost, Limits, PlannerError, cases, lq
from planner.jerk import JerkDynamics, remembering
from planner.objective import EFFORT_SHARE, plain, weights_of, with_objective
