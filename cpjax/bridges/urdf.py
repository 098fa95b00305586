"""Reading of a cart-pole from the unified robot description format (URDF), without another package."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float

from cpjax.bridges.mechanism import Body, Joint, Mechanism, Vector
from cpjax.errors import InputError

GRAVITY = 9.81
"""The format's files state no gravity; here it acts along -z [m/s^2]."""

TURNING, SLIDING = ("revolute", "continuous"), "prismatic"


class Frame(NamedTuple):
    """Orientation and place of a link in the world, with all joints at 0."""

    axes: Float[np.ndarray, "3 3"]
    origin: Vector

    def then(self, element: Element | None, where: str) -> "Frame":
        """Returns the frame that an element's <origin> places in this one."""
        origin = None if element is None else element.find("origin")
        if origin is None:
            return self
        roll, pitch, yaw = _numbers(where, origin, "rpy", (0.0, 0.0, 0.0))
        offset = np.array(_numbers(where, origin, "xyz", (0.0, 0.0, 0.0)))
        turned = _turn(2, yaw) @ _turn(1, pitch) @ _turn(0, roll)
        return Frame(self.axes @ turned, self.origin + self.axes @ offset)


class _Placed(NamedTuple):
    """A link in its place."""

    element: Element
    frame: Frame
    moved_by: tuple[Element, ...]


def read_urdf(path: Path, robot: Element) -> Mechanism:
    """Returns the cart-pole in a URDF file; extensions such as <gazebo> and <transmission> are not read.

    Args:
      path: the file's name, for error messages.
      robot: the file's root element.

    Raises:
      InputError: other moving joints than one prismatic and one revolute or continuous joint on it, a moved link with
        geometry and without <inertial>, a text that is no number, or links that form no tree.
    """
    file = str(path)
    moving = [joint for joint in robot.findall("joint") if joint.get("type") != "fixed"]
    slides = [joint for joint in moving if joint.get("type") == SLIDING]
    hinges = [joint for joint in moving if joint.get("type") in TURNING]
    if (len(moving), len(slides), len(hinges)) != (2, 1, 1):
        words = ", ".join(f"{joint.get('name')} ({joint.get('type')})" for joint in moving)
        allowed = "one prismatic joint, of the cart, and one revolute or continuous joint, of the pole on it"
        raise InputError(f"{file}: joints", words, allowed)
    slide, hinge = slides[0], hinges[0]
    links = _placed(file, robot)
    pole = [link for link in links if link.moved_by == (slide, hinge)]
    cart = [link for link in links if link.moved_by == (slide,)]
    if not pole:
        raise InputError(f"{file}: joints", "a hinge that carries the slide", "a slide that carries the hinge")
    places = {link.element.get("name"): link.frame for link in links}
    (_, effort), along = _limits(file, slide), _joint(file, slide, places)
    return Mechanism(
        file=file,
        gravity=np.array([0.0, 0.0, -GRAVITY]),
        slide=along,
        hinge=_joint(file, hinge, places),
        cart=_bodies(file, cart),
        pole=_bodies(file, pole),
        outline=_outline(file, pole),
        gain=1.0,
        limit=effort,
    )


def _placed(file: str, robot: Element) -> list[_Placed]:
    """Returns all links in their places, from the root outwards."""
    links = {link.get("name"): link for link in robot.findall("link")}
    joints: dict[str | None, list[Element]] = {}
    children = []
    for joint in robot.findall("joint"):
        ends = [end.get("link") if (end := joint.find(side)) is not None else None for side in ("parent", "child")]
        if any(name not in links for name in ends):
            raise InputError(f"{file}: joint {joint.get('name')}: parent and child", ends, "names of two links")
        if joint.find("mimic") is not None:
            raise InputError(f"{file}: joint {joint.get('name')}: mimic", "present", "absent: a cart-pole has none")
        joints.setdefault(ends[0], []).append(joint)
        children.append(ends[1])
    roots = [name for name in links if name not in children]
    if len(links) != len(robot.findall("link")) or len(roots) != 1 or len(set(children)) != len(children):
        raise InputError(f"{file}: links", len(links), "links of different names, which joints connect to one tree")
    found = [_Placed(links[roots[0]], Frame(np.eye(3), np.zeros(3)), ())]
    for link in found:  # grows while it is walked
        for joint in joints.get(link.element.get("name"), []):
            frame = link.frame.then(joint, f"{file}: joint {joint.get('name')}")
            moved_by = link.moved_by if joint.get("type") == "fixed" else (*link.moved_by, joint)
            child = joint.find("child")
            assert child is not None
            found.append(_Placed(links[child.get("link")], frame, moved_by))
    if len(found) < len(links):
        raise InputError(f"{file}: links", len(links) - len(found), "0 that no chain of joints connects to the root")
    return found


def _bodies(file: str, links: Sequence[_Placed]) -> list[Body]:
    """Returns the links that have mass; a link without <inertial> and geometry is a frame."""
    found = []
    for link in links:
        name = f"link {link.element.get('name')}"
        where, inertial = f"{file}: {name}: inertial", link.element.find("inertial")
        if inertial is None:
            if link.element.find("visual") is not None or link.element.find("collision") is not None:
                raise InputError(where, "missing", "present: this link has a shape and moves, so it has mass")
            continue
        frame = link.frame.then(inertial, where)
        (mass,) = _numbers(where, inertial.find("mass"), "value")
        tensor = inertial.find("inertia")
        xx, xy, xz, yy, yz, zz = (
            _numbers(where, tensor, key, (0.0,) if key in ("ixy", "ixz", "iyz") else None)[0]
            for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        )
        local = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        found.append(Body(name, mass, frame.origin, frame.axes @ local @ frame.axes.T))
    return found


def _outline(file: str, links: Sequence[_Placed]) -> list[tuple[Vector, float]]:
    """Returns balls that contain the links' geometry; none if that of a link with mass is missing or a mesh."""
    found = []
    for link in links:
        shapes = [*link.element.findall("visual"), *link.element.findall("collision")]
        if not shapes and link.element.find("inertial") is not None:
            return []
        for shape in shapes:
            where = f"{file}: link {link.element.get('name')}: geometry"
            geometry = shape.find("geometry")
            for solid in () if geometry is None else geometry:
                if solid.tag == "box":
                    radius = 0.5 * math.hypot(*_numbers(where, solid, "size", length=3))
                elif solid.tag == "sphere":
                    (radius,) = _numbers(where, solid, "radius")
                elif solid.tag in ("cylinder", "capsule"):
                    (across,), (along,) = (_numbers(where, solid, key) for key in ("radius", "length"))
                    radius = math.hypot(across, 0.5 * along) if solid.tag == "cylinder" else across + 0.5 * along
                else:
                    return []
                found.append((link.frame.then(shape, where).origin, radius))
    return found


def _joint(file: str, joint: Element, places: dict[str | None, Frame]) -> Joint:
    where = f"{file}: joint {joint.get('name')}"
    child = joint.find("child")
    assert child is not None
    frame, dynamics = places[child.get("link")], joint.find("dynamics")
    axis = joint.find("axis")
    given = np.array((1.0, 0.0, 0.0) if axis is None else _numbers(where, axis, "xyz", length=3))
    size = float(np.linalg.norm(given))
    if not size > 0.0:
        raise InputError(f"{where}: axis", given.tolist(), "a vector that is not zero")
    damping, friction = (
        0.0 if dynamics is None else _numbers(where, dynamics, key, (0.0,))[0] for key in ("damping", "friction")
    )
    return Joint(
        name=f"joint {joint.get('name')}",
        anchor=frame.origin,
        axis=frame.axes @ given / size,
        position=0.0,
        damping=damping,
        dry_friction=friction,
        armature=0.0,
        range=_limits(file, joint)[0],
    )


def _limits(file: str, joint: Element) -> tuple[tuple[float, float] | None, float]:
    """Returns the range of a joint, or None, and its largest force."""
    where, limit = f"{file}: joint {joint.get('name')}: limit", joint.find("limit")
    if limit is None:
        return None, math.inf
    (low,), (high,) = (_numbers(where, limit, key, (0.0,)) for key in ("lower", "upper"))
    effort = math.inf if limit.get("effort") is None else _numbers(where, limit, "effort")[0]
    if joint.get("type") == SLIDING and not effort > 0.0:
        raise InputError(f"{where}: effort", effort, "above 0 N: the force that moves the cart")
    return (None if joint.get("type") == "continuous" else (low, high)), effort


def _numbers(
    where: str, element: Element | None, key: str, default: tuple[float, ...] | None = None, length: int | None = None
) -> tuple[float, ...]:
    """Returns the finite numbers in an attribute, as many as `default` has, or `length`, or one."""
    text = None if element is None else element.get(key)
    if text is None and default is not None:
        return default
    count = length or (1 if default is None else len(default))
    try:
        found = tuple(float(part) for part in (text or "").split())
    except ValueError:
        found = ()
    if len(found) != count or not all(math.isfinite(number) for number in found):
        raise InputError(f"{where}: {key}", text, "a finite number" if count == 1 else f"{count} finite numbers")
    return found


def _turn(axis: int, angle: float) -> Float[np.ndarray, "3 3"]:
    """Returns the rotation about a coordinate axis."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[a, a] = matrix[b, b] = math.cos(angle)
    matrix[b, a], matrix[a, b] = math.sin(angle), -math.sin(angle)
    return matrix
