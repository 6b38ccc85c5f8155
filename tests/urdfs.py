"""Small URDFs for tests."""

BALL = '<sphere radius="0.05"/>'


def inertial(mass=1.0, six=(0.02, 0.03, 0.04, 0.001, -0.002, 0.003), xyz="0 0 0.1", rpy="0 0 0"):
    keys = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    entries = " ".join(f'{key}="{value!r}"' for key, value in zip(keys, six, strict=True))
    return f'<inertial><origin xyz="{xyz}" rpy="{rpy}"/><mass value="{mass!r}"/><inertia {entries}/></inertial>'


def link(name, *parts):
    return f'<link name="{name}">{"".join(parts)}</link>'


def shape(kind, geometry, xyz="0 0 0"):
    return f'<{kind}><origin xyz="{xyz}"/><geometry>{geometry}</geometry></{kind}>'


def joint(name, parent, child, kind="revolute", xyz="0 0 0.3", rpy="0 0 0", axis="0 1 0", more=None):
    more = '<limit lower="-1" upper="2" effort="30" velocity="3"/>' if more is None else more
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{more}</joint>'
    )


def robot(*parts):
    return f'<?xml version="1.0"?><robot name="robot">{"".join(parts)}</robot>'


UNCLEAR = tuple(f"the {what} of joint 'elbow' (the file has {has})" for what, has in (
    ("range", "none"), ("effort limit", "0"), ("velocity limit", "0"),
))  # fmt: skip
"""What a plan with ARM is said to be without."""
ARM = robot(
    link("base", inertial(3.0)),
    link("upper", inertial(2.0, rpy="0.3 -0.7 1.1")),
    link("fore", inertial(1.5, xyz="0.05 -0.02 0.1")),
    link("slider", inertial(0.7, rpy="-1.2 0.4 0.2")),
    link("tool", inertial(0.3)),
    joint("shoulder", "base", "upper", rpy="0.2 0.5 -0.4", axis="1 2 -0.5"),
    joint("elbow", "upper", "fore", rpy="-1.3 0.1 2.2", xyz="0.1 0 0.4", more='<limit effort="0" velocity="0"/>'),
    joint("slide", "fore", "slider", "prismatic", rpy="0.1 0.2 0.3", axis="0 0 1",
          more='<limit lower="-0.1" upper="0.2" effort="50" velocity="0.5"/><dynamics damping="0.4"/>'),
    joint("flange", "slider", "tool", "fixed", xyz="0 0.02 0.15", rpy="0 1.5 0", more=""),
)  # fmt: skip
"""Oblique axes, rotated inertias, and a tool that is fixed."""
