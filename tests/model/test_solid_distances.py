"""Signed distances of solids: against MuJoCo's where shapes are exact, their directions against differences."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from planner.base.errors import PlannerError
from planner.model.contact import signed_distance
from planner.model.contact.bounding_fit import fit_bounding_shape, rim_points, round_points, sphere
from planner.model.contact.signed_distance import PlacedShapes
from planner.model.mjcf.collision_pairs import select_collision_pairs
from planner.model.mjcf.initial_overlaps import (
    MAX_MUJOCO_DISTANCE,
    distances_in,
    may_collide,
    min_distance_over_ranges,
)
from planner.model.mjcf.model_index import ModelIndex, contact_pairs

SIZES = {"sphere": (0.1,), "capsule": (0.05, 0.3), "box": (0.1, 0.2, 0.3), "plane": (1.0, 1.0, 1.0)}
PAIRS = {
    ("sphere", "sphere"): signed_distance.segment_segment, ("sphere", "capsule"): signed_distance.segment_segment,
    ("capsule", "capsule"): signed_distance.segment_segment, ("sphere", "box"): signed_distance.segment_box,
    ("capsule", "box"): signed_distance.segment_box, ("box", "box"): signed_distance.of_boxes,
    ("sphere", "plane"): signed_distance.from_plane, ("capsule", "plane"): signed_distance.from_plane,
    ("box", "plane"): signed_distance.from_plane,
}  # fmt: skip
K = 150


def core(kind):
    size = SIZES[kind]
    half = {"capsule": (0.0, 0.0, size[-1]), "box": size}.get(kind, (0.0, 0.0, 0.0))
    return np.tile(half, (K, 1)), np.full(K, size[0] if kind in ("sphere", "capsule") else 0.0)


def poses(seed=0):
    rng = np.random.default_rng(seed)
    return Rotation.random(2 * K, random_state=seed).as_matrix().reshape(K, 2, 3, 3), rng.uniform(-0.3, 0.3, (K, 2, 3))


def measured(kinds, R, x):
    placed = [PlacedShapes(R[:, i], x[:, i], *core(kind)) for i, kind in enumerate(kinds)]
    return PAIRS[kinds](*placed)


@pytest.mark.parametrize("kinds", PAIRS, ids="-".join)
def test_exact_shapes_are_as_far_apart_as_mujoco_measures(kinds):
    R, x = poses()
    geoms = [f'<body mocap="true"><geom type="{k}" size="{" ".join(map(str, SIZES[k]))}"/></body>' for k in kinds]
    option = '<option ccd_tolerance="1e-12" ccd_iterations="500"/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{option}<worldbody>{''.join(geoms)}</worldbody></mujoco>")
    data, theirs = mujoco.MjData(model), np.empty(K)
    for k in range(K):
        data.mocap_pos[:] = x[k]
        for i in range(2):
            mujoco.mju_mat2Quat(data.mocap_quat[i], R[k, i].ravel())
        mujoco.mj_kinematics(model, data)
        theirs[k] = mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None)
    near = measured(kinds, R, x)
    radii = core(kinds[0])[1] + core(kinds[1])[1]
    # MuJoCo's depth of a capsule whose axis is within a box is that of one of its ends, not the shortest way out
    known = (near.distance + radii > 0.0) if kinds == ("capsule", "box") else np.ones(K, dtype=bool)
    assert known.sum() > 0.6 * K
    assert 5 < np.sum(near.distance[known] < 0.0) < K - 5
    np.testing.assert_allclose(near.distance[known], theirs[known], rtol=0, atol=1e-9)


def test_a_line_in_a_box_is_as_deep_as_a_box_without_width():
    R, x = poses(1)
    x = 0.4 * x  # most overlap
    line, thin = (PlacedShapes(R[:, 0], x[:, 0], core("capsule")[0], np.zeros(K)) for _ in range(2))
    box = PlacedShapes(R[:, 1], x[:, 1], *core("box"))
    a, b = signed_distance.segment_box(line, box), signed_distance.of_boxes(thin, box)
    assert np.sum(a.distance < 0.0) > 0.5 * K
    np.testing.assert_allclose(a.distance, b.distance, rtol=0, atol=1e-12)
    out = PlacedShapes(R[:, 0], x[:, 0] - a.distance[:, None] * a.n, core("capsule")[0], np.zeros(K))
    deep = a.distance < 0.0
    np.testing.assert_allclose(
        signed_distance.segment_box(out, box).distance[deep], 0.0, atol=1e-9
    )  # the way leads out


@pytest.mark.parametrize("kinds", PAIRS, ids="-".join)
def test_directions_are_differences_of_the_distance(kinds):
    """Of the first solid's place, and of turns of it about the world's origin: n and p x n."""
    (R, x), h = poses(2), 1e-6
    near, found = measured(kinds, R, x), np.empty((K, 6))
    for i in range(3):
        step = h * np.eye(3)[i]
        turn = Rotation.from_rotvec(step).as_matrix()

        def moved(shift, Q):
            there, turned = x.copy(), R.copy()
            there[:, 0], turned[:, 0] = x[:, 0] @ Q.T + shift, Q @ R[:, 0]
            return measured(kinds, turned, there).distance

        found[:, i] = (moved(step, np.eye(3)) - moved(-step, np.eye(3))) / (2.0 * h)
        found[:, 3 + i] = (moved(0.0, turn) - moved(0.0, turn.T)) / (2.0 * h)
    np.testing.assert_allclose(np.linalg.norm(near.n, axis=1), 1.0, atol=1e-12)
    expected = np.concatenate([near.n, np.cross(near.p, near.n)], axis=1)
    np.testing.assert_allclose(expected, found, rtol=0, atol=1e-8)  # rounding over h, 1e-10, and curvature times h


# ---------------------------------------------------------------------------------------------------------- fits


@pytest.mark.parametrize(
    ("points", "most"),
    [  # the excess that a capsule or round box must have, by hand, and a quarter more for a search that is not exact
        (rim_points(0.05, 0.5), 1.25 * 0.05 * (2**0.5 - 1)),  # a box of the same length: its corners
        (round_points(np.array([0.1, 0.1, 0.1])), 0.005),  # a sphere, whose points stand out by 1 %
        (sphere(300) * 0.05 + np.array([0.0, 0.0, 0.3]) * np.sign(sphere(300)[:, 2:]), 0.005),  # a capsule
        (np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T * [0.1, 0.2, 0.3], 0.01),  # a box
    ],
    ids=["cylinder", "sphere", "capsule", "box"],
)  # fmt: skip
def test_fits_hold_all_points_and_say_how_far_they_reach_beyond(points, most):
    fit = fit_bounding_shape(points)
    local = (points - fit.T[:3, 3]) @ fit.T[:3, :3]
    assert np.linalg.norm(local - np.clip(local, -fit.half, fit.half), axis=1).max() <= fit.radius + 1e-12
    n = Rotation.random(3000, random_state=0).as_matrix()[:, 0]
    beyond = n @ fit.T[:3, 3] + np.abs(n @ fit.T[:3, :3]) @ fit.half + fit.radius - np.max(n @ points.T, axis=1)
    assert beyond.min() > -1e-12
    assert beyond.max() < fit.overestimate + 1e-3
    assert fit.overestimate < most


# ---------------------------------------------------------------------------------------------------------- pairs

SCENE = """<mujoco><worldbody>
  <geom name="floor" type="plane" size="5 5 .1"/>
  <geom name="near" type="sphere" size="0.1" pos="0.9 0 1"/>
  <geom name="far" type="sphere" size="0.1" pos="-1.5 0 1"/>
  <geom name="ghost" type="sphere" size="0.1" pos="0.5 0 1" contype="0" conaffinity="0"/>
  <body name="base" pos="0 0 1"><geom name="base" type="sphere" size="0.1"/>
    <body name="arm"><joint name="a" axis="0 0 1" range="-60 60"/>
      <geom name="arm" type="capsule" fromto="0 0 0 0.4 0 0" size="0.05"/>
      <body name="fore" pos="0.4 0 0"><joint name="b" axis="0 0 1" range="-150 150"/>
        <geom name="fore" type="capsule" fromto="0.06 0 0 0.4 0 0" size="0.05"/>
        <body name="hand" pos="0.4 0 0"><joint name="c" axis="0 1 0" range="-90 90"/>
          <geom name="hand" type="cylinder" fromto="0.1 0 0 0.2 0 0" size="0.04"/></body></body></body></body>
</worldbody><contact><exclude body1="base" body2="hand"/></contact></mujoco>"""


@pytest.fixture(scope="module")
def survey():
    return ModelIndex(mujoco.MjModel.from_xml_string(SCENE))


def named(survey, near):
    return {frozenset(survey.model.geom(solid.geom).name for solid in pair[:2]) for pair in near.pairs}


def test_pairs_that_can_come_near_are_kept_apart(survey):
    near = select_collision_pairs(survey, {"the start": np.array([1.0, 0.5, 0.0])}, 0.02)
    found = named(survey, near)
    assert {"near", "hand"} in found
    assert {"arm", "hand"} in found
    assert not any({"far", "ghost"} & pair for pair in found)  # out of reach within the ranges; collides with nothing
    assert {"base", "hand"} not in found
    notes = " ".join(near.notes)
    assert "since the model excludes them: base and hand" in notes
    assert "1 shape is fitted" in notes
    assert near.notes[0] == f"{len(near.pairs)} pairs of shapes are kept 0.02 m apart (left out: 2)."
    assert "geom 'base' and geom 'arm'" in notes  # drawn into each other: the base does not move
    own = select_collision_pairs(survey, {"the start": np.array([1.0, 0.5, 0.0])}, 0.02, world=False)
    assert named(survey, own) < found
    assert not any({"near", "floor"} & pair for pair in named(survey, own))
    rest = select_collision_pairs(survey, {"the start": np.array([1.0, 0.5, 0.0])}, 0.02, own=False)
    assert named(survey, rest) | named(survey, own) == found


def test_what_is_said_to_be_out_of_reach_is(survey):
    rng, model = np.random.default_rng(0), survey.model
    pairs = contact_pairs(model)
    out = [pair for pair in pairs if not may_collide(survey, pair, 0.02)]
    assert {frozenset(model.geom(geom).name for geom in pair) for pair in out} >= {frozenset(("far", "arm"))}
    low, high = model.jnt_range.T
    for _ in range(200):
        found = distances_in(model, rng.uniform(low, high), out, 1.0)
        assert min(found.values()) > 0.02


def test_a_start_in_collision_or_too_near_is_refused(survey):
    with pytest.raises(PlannerError) as error:
        select_collision_pairs(survey, {"the start": np.zeros(3)}, 0.02)
    assert str(error.value).startswith("the start is in collision: geom 'near' and geom ")
    assert "overlap by 0.1 m, expected a pose where nothing touches" in str(error.value)
    with pytest.raises(PlannerError) as error:
        select_collision_pairs(
            survey, {"the start": np.array([1.0, 0.0, 0.0]), "the goal": np.array([0.0, 0.42, 0.0])}, 0.1
        )
    assert str(error.value).startswith("the goal has geom 'near' and geom ")
    assert "write clearance = 0.0" in str(error.value)


# Two short cylinders, one above the other, which turn against each other about one axis: no pose brings them nearer.
STACKED = """<mujoco><worldbody>
  <body name="base"><geom name="base" type="cylinder" size="0.08 0.08"/>
    <body name="turret"><joint name="turn" axis="0 0 1" range="-170 170"/>
      <geom type="sphere" size="0.01" pos="0.3 0 0.3"/>
      <body name="drum" pos="0 0 0.162"><joint name="roll" axis="{axis}" range="-170 170"/>
        <geom name="drum" type="cylinder" size="0.08 0.08"/></body></body></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize(("axis", "kept"), [("0 0 1", False), ("0 1 0", True)])
def test_fits_that_overlap_are_let_be_where_no_pose_brings_the_shapes_nearer(axis, kept):
    survey = ModelIndex(mujoco.MjModel.from_xml_string(STACKED.format(axis=axis)))
    near = select_collision_pairs(survey, {"the start": np.zeros(2)}, 0.01)
    assert (frozenset(("base", "drum")) in named(survey, near)) == kept
    notes = " ".join(near.notes)
    assert ("no pose brings the shapes nearer, though their fits overlap: geom 'base' and geom 'drum'" in notes) != kept


def test_how_near_a_pair_comes_in_any_pose_is_not_above_what_random_poses_say(survey):
    model, rng = survey.model, np.random.default_rng(1)
    pairs = [pair for pair in contact_pairs(model) if may_collide(survey, pair, 0.02)]
    poses = rng.uniform(*model.jnt_range.T, size=(300, model.nq))
    least = {
        pair: min(distances_in(model, qpos, [pair], MAX_MUJOCO_DISTANCE)[pair] for qpos in poses) for pair in pairs
    }
    known = {pair: min_distance_over_ranges(survey, pair, [poses[0]]) for pair in pairs}
    assert sum(np.isfinite(value) for value in known.values()) >= 4  # with one or two joints between their shapes
    for pair in pairs:
        assert known[pair] <= least[pair] + 1e-9
