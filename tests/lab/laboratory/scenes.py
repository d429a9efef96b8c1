"""The three scenes of the laboratory as Mitsuba files, in the scan's axes: x left, y up, z forward.

Lengths are metres. The camera is at the origin, and the laser is beside it on the x axis.
"""

import math
from dataclasses import dataclass

BASELINE_M = 0.257


@dataclass(frozen=True)
class Scene:
    """A scene, the view of the detector, and the way to its spots."""

    name: str
    # Limits of the view in the plane z = 1, [u, v]; None takes those of the detector's scan.
    view: tuple | None
    # The laser scan with the voltages of the spots, the factor on their slopes, and the depth at which
    # a beam without voltage crosses the axis of the camera.
    laser_scan: str
    spread: float
    aim_m: float
    # First path and last path of the gate, metres.
    gate: tuple
    shapes: tuple


def box(low, high, material="white"):
    """Returns a cuboid between two corners."""
    middle = [(a + b) / 2 for a, b in zip(low, high)]
    half = [(b - a) / 2 for a, b in zip(low, high)]
    return f'<shape type="cube"><transform name="to_world">{scale(half)}{translate(middle)}</transform>{ref(material)}</shape>'


def turned(centre, half, degrees, material="white"):
    """Returns a cuboid that is turned about the vertical axis."""
    turn = f'<rotate y="1" angle="{degrees}"/>'
    return (
        f'<shape type="cube"><transform name="to_world">{scale(half)}{turn}{translate(centre)}</transform>'
        f"{ref(material)}</shape>"
    )


def ball(centre, half, material="white"):
    """Returns an ellipsoid."""
    return (
        f'<shape type="sphere"><transform name="to_world">{scale(half)}{translate(centre)}</transform>'
        f"{ref(material)}</shape>"
    )


def rod(foot, top, radius, material="white"):
    """Returns a cylinder with a lid."""
    points = "".join(
        f'<point name="{name}" x="{p[0]}" y="{p[1]}" z="{p[2]}"/>' for name, p in (("p0", foot), ("p1", top))
    )
    side = f'<shape type="cylinder">{points}<float name="radius" value="{radius}"/>{ref(material)}</shape>'
    flat = f'<rotate x="1" angle="-90"/>{scale([radius, radius, radius])}{translate(top)}'
    lid = f'<shape type="disk"><transform name="to_world">{flat}</transform>{ref(material)}</shape>'
    return side + lid


def scale(by):
    return f'<scale x="{by[0]}" y="{by[1]}" z="{by[2]}"/>'


def translate(by):
    return f'<translate x="{by[0]}" y="{by[1]}" z="{by[2]}"/>'


def ref(material):
    return f'<ref id="{material}"/>'


def room(left, right, low, high, far, near=0.02):
    """Returns floor, ceiling, two side walls and the far wall; the room is open behind the camera."""
    thick = 0.02
    return (
        box((right, low - thick, near), (left, low, far)),
        box((right, high, near), (left, high + thick, far)),
        box((left, low, near), (left + thick, high, far)),
        box((right - thick, low, near), (right, high, far)),
        box((right - thick, low - thick, far), (left + thick, high + thick, far + thick)),
    )


HALF_46 = math.tan(math.radians(23.0))

FOAM = Scene(
    name="foam",
    view=((-HALF_46, HALF_46), (-HALF_46, HALF_46)),
    laser_scan="TCI_large_scene_16pts--laser_scan_16pts.mat",
    # All beams end inside of the narrower view, most on side walls, floor and ceiling: a spot gives no
    # two-bounce light to its own wall.
    spread=0.8,
    aim_m=1.1,
    gate=(0.9, 4.5),
    shapes=(
        *room(0.40, -0.31, -0.25, 0.29, 1.25),
        turned((0.13, -0.19, 0.95), (0.06, 0.06, 0.06), 28),
        # The cylinder of the laboratory is one inch wide.
        rod((-0.13, -0.25, 0.98), (-0.13, -0.05, 0.98), 0.0127),
        box((-0.24, 0.09, 1.245), (-0.10, 0.23, 1.249), "mirror"),
    ),
)

HEAD = Scene(
    name="head",
    view=None,
    laser_scan="TCI_large_scene_16pts--laser_scan_16pts.mat",
    spread=1.0,
    aim_m=1.9,
    gate=(0.9, 6.2),
    shapes=(
        *room(0.75, -0.55, -0.72, 0.50, 1.90),
        ball((0.10, 0.02, 1.30), (0.085, 0.125, 0.105)),
        ball((0.10, 0.00, 1.195), (0.014, 0.022, 0.024)),
        ball((0.188, 0.01, 1.30), (0.012, 0.030, 0.020)),
        ball((0.012, 0.01, 1.30), (0.012, 0.030, 0.020)),
        rod((0.10, -0.24, 1.32), (0.10, -0.08, 1.32), 0.055),
        ball((0.10, -0.34, 1.34), (0.23, 0.14, 0.11)),
        box((-0.10, -0.72, 1.20), (0.30, -0.46, 1.50)),
    ),
)

CORNER = Scene(
    name="corner",
    view=None,
    laser_scan="Depth_Chart_Collection--laser_scan_16pts.mat",
    spread=1.15,
    aim_m=2.0,
    gate=(0.9, 6.2),
    shapes=(
        # Two walls that meet at a right angle, ahead of the camera.
        turned((0.87, -0.15, 1.50), (1.1, 0.75, 0.02), 45),
        turned((-0.67, -0.15, 1.50), (1.1, 0.75, 0.02), -45),
        box((-1.50, -0.92, 0.02), (1.70, -0.90, 2.40)),
        box((-1.50, 0.60, 0.02), (1.70, 0.62, 2.40)),
        # An armchair.
        turned((0.42, -0.80, 1.40), (0.24, 0.10, 0.22), 20),
        turned((0.49, -0.52, 1.60), (0.24, 0.30, 0.05), 20),
        turned((0.66, -0.68, 1.33), (0.04, 0.16, 0.20), 20),
        turned((0.19, -0.68, 1.49), (0.04, 0.16, 0.20), 20),
        # A table with a lamp.
        box((-0.52, -0.52, 1.05), (-0.12, -0.48, 1.42)),
        *(rod((x, -0.90, z), (x, -0.52, z), 0.018) for x in (-0.49, -0.15) for z in (1.08, 1.39)),
        rod((-0.32, -0.48, 1.24), (-0.32, -0.25, 1.24), 0.02),
        ball((-0.32, -0.18, 1.24), (0.10, 0.09, 0.10)),
    ),
)

SCENES = {scene.name: scene for scene in (FOAM, HEAD, CORNER)}


def mitsuba(scene, focal, principal, size, directions):
    """Returns the scene as text.

    focal is in widths of the image, principal is the principal point's offset in widths and heights,
    and directions are those of the beams.
    """
    fov = 2 * math.degrees(math.atan(0.5 / focal))
    beams = []
    for x, y, z in directions:
        target = f"{BASELINE_M + x}, {y}, {z}"
        beams.append(
            '<emitter type="spot"><float name="cutoff_angle" value="0.5"/><transform name="to_world">'
            f'<lookat origin="{BASELINE_M}, 0, 0" target="{target}" up="0, 1, 0"/></transform></emitter>'
        )
    white = '<bsdf type="diffuse" id="white"><rgb name="reflectance" value="0.8, 0.8, 0.8"/></bsdf>'
    mirror = '<bsdf type="conductor" id="mirror"><string name="material" value="none"/></bsdf>'
    return (
        '<scene version="3.0.0"><sensor type="perspective">'
        f'<float name="fov" value="{fov}"/><string name="fov_axis" value="x"/>'
        f'<float name="principal_point_offset_x" value="{principal[0]}"/>'
        f'<float name="principal_point_offset_y" value="{principal[1]}"/>'
        '<transform name="to_world"><lookat origin="0, 0, 0" target="0, 0, 1" up="0, 1, 0"/></transform>'
        f'<film type="hdrfilm"><integer name="width" value="{size}"/><integer name="height" value="{size}"/></film>'
        f"</sensor>{white}{mirror}{''.join(beams)}{''.join(scene.shapes)}</scene>"
    )
