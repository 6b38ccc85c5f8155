"""How deep MuJoCo's soft contact lets a ball sink in is its documentation's formula, to rounding of a ball at rest."""

import mujoco
import pytest

from planner.model.mjcf.ground_law import DEEPEST, rest_penetration
from planner.model.mjcf.model_index import ModelIndex, compile_model

BALL = """<mujoco><option cone="{cone}" impratio="{impratio}" timestep=".001"/><worldbody>
  <geom type="plane" size="0 0 1"/><body pos="0 0 .1"><freejoint/>
    <geom size=".1" mass="2" priority="1" condim="{condim}" friction="{mu}" solref="{solref}" solimp="{solimp}"/>
  </body></worldbody></mujoco>"""
WEIGHT = 2.0 * 9.81


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize(
    ("condim", "mu", "solref", "solimp", "impratio"),
    [
        (3, 1.0, ".02 1", ".9 .95 .001 .5 2", 1),  # MuJoCo's defaults
        (3, 0.6, ".02 1", ".015 1 .03 .5 2", 1),  # rubber feet, as many quadrupeds have them
        (6, 0.8, ".01 .7", ".8 .8 .01 .5 2", 1),
        (1, 1.0, "-1000 -50", ".5 .9 .01 .3 3", 1),
        (4, 0.7, ".02 1", ".9 .95 .001 .5 2", 10),
    ],
)
def test_a_ball_sinks_in_as_deep_as_the_formula_says(cone, condim, mu, solref, solimp, impratio):
    model = compile_model(BALL.format(cone=cone, condim=condim, mu=mu, solref=solref, solimp=solimp, impratio=impratio))
    data = mujoco.MjData(model)
    for _ in range(4000):
        mujoco.mj_step(model, data)
    # What is left of its fall after 4 s is below a nanometre.
    depth, _ = rest_penetration(model, ModelIndex(model).pairs[0], WEIGHT)
    assert depth == pytest.approx(0.1 - data.qpos[2], abs=1e-9)


def test_what_carries_nothing_is_as_deep_as_can_be():
    model = compile_model(
        BALL.format(cone="elliptic", condim=1, mu=1, solref="-1 -1", solimp=".1 .1 .01 .5 2", impratio=1)
    )
    assert rest_penetration(model, ModelIndex(model).pairs[0], WEIGHT)[0] == pytest.approx(DEEPEST)
