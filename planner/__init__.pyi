# The public names, written once: type checkers read this file, and planner/__init__.py looks names up in it.
from planner import cases as cases
from planner import contact as contact
from planner import costs as costs
from planner import dynamics as dynamics
from planner import paper as paper
from planner import proof as proof
from planner.base.errors import ModelError as ModelError
from planner.base.errors import PlannerError as PlannerError
from planner.cases.plan_file import load_plan as load_plan
from planner.cases.problem_file import load_problem as load_problem
from planner.dynamics import FunctionDynamics as FunctionDynamics
from planner.dynamics import RigidBodyDynamics as RigidBodyDynamics
from planner.model.mechanism import Mechanism as Mechanism
from planner.model.twin import Twin as Twin
from planner.problem.costs.frame import FrameCost as FrameCost
from planner.problem.costs.penalty import PenaltyCost as PenaltyCost
from planner.problem.costs.terms import Cost as Cost
from planner.problem.costs.tracking import TrackingCost as TrackingCost
from planner.problem.limits import Limits as Limits
from planner.problem.plan import Plan as Plan
from planner.problem.plan import Status as Status
from planner.problem.problem import Problem as Problem
from planner.proof.compare.model_parity import parity as parity
from planner.proof.refinement import refine as refine
from planner.proof.replays.replaying import Replay as Replay
from planner.proof.replays.replaying import replay as replay
from planner.proof.steps import prove as prove
from planner.proof.verdict import Proof as Proof
from planner.solvers.free_time import solve_for as solve_for
from planner.solvers.periodic import solve_periodic as solve_periodic
from planner.solvers.slq import solve as solve
from planner.sweeps.stored_plans import check as check
from planner.view.render.video import render_frame as render_frame
from planner.view.render.video import render_strip as render_strip
from planner.view.render.video import render_video as render_video

__version__: str
