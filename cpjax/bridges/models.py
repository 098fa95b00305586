"""Cart-poles in files of other simulators: MuJoCo's MJCF and the robots' URDF."""

from pathlib import Path
from xml.etree import ElementTree

from cpjax.bridges.mechanism import ImportedModel, imported
from cpjax.bridges.mjcf import read_mjcf
from cpjax.bridges.urdf import read_urdf
from cpjax.errors import InputError

__all__ = ["ImportedModel", "load_model"]


def load_model(path: str | Path) -> ImportedModel:
    """Reads a cart-pole from an MJCF or URDF file, as a rig with the same equations of motion.

    The file has two moving joints: a slide, whose bodies are the cart, and on it a hinge, whose bodies are the pole.
    Masses and inertias come from <inertial>, or in MJCF from the geoms, as MuJoCo's compiler computes them. The slide's
    range becomes the track and the middle of it x = 0; damping and dry friction of the joints become the plant's; the
    armature of the slide is the drive's reflected mass, that of the hinge is part of the pole's inertia. The command
    keeps its meaning: it is MuJoCo's control, a `LumpedMotor` with the motor's gear as force per command, or a
    `ForceActuator` where the gear is 1. In URDF it is a force up to the limit's effort, and gravity is 9.81 m/s^2 along
    -z.

    Contacts, the hinge's range (see `ImportedModel.left_out`), sensors and the integrator's settings are not read.
    MuJoCo stops the cart at an end of its range, softly; here a run ends there (`Track.ends` can be "stop").

    Args:
      path: of the file; its root element, mujoco or robot, decides the format. MJCF needs the package `mujoco`.

    Returns:
      The rig, and the conversion between the file's joint coordinates and states.

    Raises:
      InputError: no such file, a file that is no XML or has a document type, another root element; a mechanism that is
        no cart-pole in a vertical plane, or has springs, tendons, other joints or actuators; a mass or an inertia that
        is missing, not positive or impossible for the pole's extent. The message names the place in the file.
    """
    if not isinstance(path, (str, Path)):
        raise InputError("path", path, "a file name, as str or Path")
    path = Path(path)
    try:
        text = path.read_bytes()
    except (OSError, ValueError) as problem:  # ValueError: a null byte in the path
        raise InputError("path", str(path), f"a readable file ({problem})") from problem
    try:
        root = ElementTree.fromstring(text, parser=ElementTree.XMLParser(target=_WithoutDoctype(path)))
    except (ElementTree.ParseError, ValueError, LookupError) as problem:  # LookupError: an unknown encoding
        if isinstance(problem, InputError):
            raise
        raise InputError("path", str(path), f"an XML file ({problem})") from problem
    if root.tag == "mujoco":
        return imported(read_mjcf(path))
    if root.tag == "robot":
        return imported(read_urdf(path, root))
    raise InputError(f"{path}: root element", root.tag, "mujoco (MJCF) or robot (URDF)")


class _WithoutDoctype(ElementTree.TreeBuilder):
    """Builds a tree, and refuses a document type, whose entities could expand without bounds."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def doctype(self, name: str, public: str | None, system: str | None) -> None:
        raise InputError(f"{self.path}: DOCTYPE", name, "absent: MJCF and URDF have none")
