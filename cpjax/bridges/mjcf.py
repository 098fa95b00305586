"""Reading of a cart-pole from MuJoCo's XML format, with what MuJoCo's compiler makes of it."""

from pathlib import Path
from typing import Any

import numpy as np

from cpjax.bridges.mechanism import Body, Joint, Mechanism
from cpjax.errors import InputError


def read_mjcf(path: Path) -> Mechanism:
    """Returns the cart-pole in an MJCF file; MuJoCo compiles it, with its includes, defaults and inertias of geoms.

    Raises:
      InputError: MuJoCo is not installed or does not compile the file; or the file has other joints than one slide and
        one hinge, another actuator than one motor on the slide, or something that a cart-pole has not.
    """
    try:
        import mujoco  # an optional package
    except ImportError as problem:
        allowed = "installed, to read MJCF files: pip install 'cpjax[peers]'"
        raise InputError("mujoco", "not installed", allowed) from problem
    warn = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: None)  # without one, MuJoCo writes a log into the present folder
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as problem:
        raise InputError("path", str(path), f"a model that MuJoCo compiles ({problem})") from problem
    finally:
        mujoco.set_mju_user_warning(warn)
    _refuse_the_rest(str(path), mujoco, model)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    slide, hinge = _joints(str(path), mujoco, model)
    chains = [_chain(model, body) for body in range(model.nbody)]
    pole = [body for body, chain in enumerate(chains) if chain == [hinge, slide]]
    cart = [body for body, chain in enumerate(chains) if chain == [slide]]
    gain, limit = _actuator(str(path), mujoco, model, slide)
    drawn = all(model.body_geomnum[body] > 0 or model.body_mass[body] == 0.0 for body in pole)
    outline = [
        (np.array(data.geom_xpos[geom]), float(model.geom_rbound[geom]))
        for geom in range(model.ngeom)
        if drawn and model.geom_bodyid[geom] in pole
    ]
    return Mechanism(
        file=str(path),
        gravity=np.array(model.opt.gravity),
        slide=_joint(mujoco, model, data, slide),
        hinge=_joint(mujoco, model, data, hinge),
        cart=[_body(model, data, body) for body in cart],
        pole=[_body(model, data, body) for body in pole],
        outline=outline,
        gain=gain,
        limit=limit,
    )


def _refuse_the_rest(file: str, mujoco: Any, model: Any) -> None:
    """Refuses what acts on the motion and no cart-pole has."""
    option, off = model.opt, mujoco.mjtDisableBit
    absent = {
        "tendon": model.ntendon,
        "equality": model.neq,
        "flex": model.nflex,
        "plugin": model.nplugin,
        "gravcomp": model.body_gravcomp,
        "option density": option.density,
        "option viscosity": option.viscosity,
        "joint stiffness": [model.jnt_stiffness, *np.transpose(model.jnt_stiffnesspoly)],
        "joint damping beyond the linear": model.dof_dampingpoly,
        "actuator delay": model.actuator_delay,
        "actuator damping": model.actuator_damping,
        "actuator armature": model.actuator_armature,
        "disabled actuator groups": option.disableactuator,
    }
    for what, value in absent.items():
        if np.any(value):
            shown = np.asarray(value).tolist()
            raise InputError(f"{file}: {what}", shown, "0 or absent: a cart-pole has none")
    for name, bit in (
        ("damper", off.mjDSBL_DAMPER),
        ("gravity", off.mjDSBL_GRAVITY),
        ("actuation", off.mjDSBL_ACTUATION),
    ):
        if option.disableflags & bit:
            raise InputError(f"{file}: option flag {name}", "disable", "enable")


def _joints(file: str, mujoco: Any, model: Any) -> tuple[int, int]:
    """Returns the numbers of the slide and of the hinge, which the slide carries."""
    slide, hinge = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
    types = [int(kind) for kind in model.jnt_type]
    if sorted(types) != sorted((slide, hinge)):
        words = [
            f"{model.joint(j).name or j} ({mujoco.mjtJoint(kind).name[6:].lower()})" for j, kind in enumerate(types)
        ]
        allowed = "one slide joint, of the cart, and one hinge joint, of the pole on it"
        raise InputError(f"{file}: joints", ", ".join(words), allowed)
    found = types.index(slide), types.index(hinge)
    if found[0] > found[1]:
        raise InputError(f"{file}: joints", "a hinge that carries the slide", "a slide that carries the hinge")
    return found


def _chain(model: Any, body: int) -> list[int]:
    """Returns the joints that move a body, its own first."""
    found: list[int] = []
    while body > 0:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        found += reversed(range(first, first + count))
        body = int(model.body_parentid[body])
    return found


def _body(model: Any, data: Any, body: int) -> Body:
    axes = np.array(data.ximat[body]).reshape(3, 3)
    inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T
    name = f"body {model.body(body).name or body}"
    return Body(name, float(model.body_mass[body]), np.array(data.xipos[body]), inertia)


def _joint(mujoco: Any, model: Any, data: Any, joint: int) -> Joint:
    off, bits = model.opt.disableflags, mujoco.mjtDisableBit
    dof = int(model.jnt_dofadr[joint])
    limited = bool(model.jnt_limited[joint]) and not off & (bits.mjDSBL_LIMIT | bits.mjDSBL_CONSTRAINT)
    rubs = not off & (bits.mjDSBL_FRICTIONLOSS | bits.mjDSBL_CONSTRAINT)
    low, high = (float(end) for end in model.jnt_range[joint])
    return Joint(
        name=f"joint {model.joint(joint).name or joint}",
        anchor=np.array(data.xanchor[joint]),
        axis=np.array(data.xaxis[joint]),
        position=float(model.qpos0[model.jnt_qposadr[joint]]),
        damping=float(model.dof_damping[dof]),
        dry_friction=float(model.dof_frictionloss[dof]) if rubs else 0.0,
        armature=float(model.dof_armature[dof]),
        range=(low, high) if limited else None,
    )


def _actuator(file: str, mujoco: Any, model: Any, slide: int) -> tuple[float, float]:
    """Returns force per control and the control's limit; 1 and infinity without an actuator."""
    if model.nactuator == 0:
        return 1.0, np.inf
    joints = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    simple = (
        model.nactuator == 1
        and int(model.actuator_trntype[0]) in joints
        and int(model.actuator_trnid[0, 0]) == slide
        and int(model.actuator_dyntype[0]) == int(mujoco.mjtDyn.mjDYN_NONE)
        and int(model.actuator_gaintype[0]) == int(mujoco.mjtGain.mjGAIN_FIXED)
        and int(model.actuator_biastype[0]) == int(mujoco.mjtBias.mjBIAS_NONE)
    )
    if not simple:
        names = [model.actuator(i).name or str(i) for i in range(model.nactuator)]
        raise InputError(f"{file}: actuator", ", ".join(names), "one motor, on the slide joint")
    force = float(model.actuator_gainprm[0, 0])
    gain = force * float(model.actuator_gear[0, 0])
    if not abs(gain) > 0.0:
        raise InputError(f"{file}: gear of the motor", gain, "another number than 0")
    clipped = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    limit = np.inf
    for what, limited, ends, per in (
        ("ctrlrange", clipped and model.actuator_ctrllimited[0], model.actuator_ctrlrange[0], 1.0),
        ("forcerange", model.actuator_forcelimited[0], model.actuator_forcerange[0], abs(force)),
        ("actuatorfrcrange", model.jnt_actfrclimited[slide], model.jnt_actfrcrange[slide], abs(gain)),
    ):
        if limited:
            if not -ends[0] == ends[1] > 0.0:
                raise InputError(f"{file}: {what} of the motor", list(map(float, ends)), "from -a to a, with a above 0")
            limit = min(limit, float(ends[1]) / per)
    return gain, limit
