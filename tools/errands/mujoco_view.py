"""Colour images of a home, rendered by MuJoCo. Needs `pip install mujoco` and EGL."""

from __future__ import annotations

import math
import os

os.environ.setdefault("MUJOCO_GL", "egl")
# Mesa's software renderer waits long for its own threads on a busy machine.
os.environ.setdefault("LP_NUM_THREADS", "0")

import mujoco
import numpy as np
from home import Home

from deworldsg_ros.scene.camera import Intrinsics

NEAR_M, FAR_M = 0.05, 30.0


class MujocoView:
    """Renders the colours of a home."""

    def __init__(self, home: Home, camera: Intrinsics) -> None:
        self._home, self._size = home, (camera.height, camera.width)
        self._model = mujoco.MjModel.from_xml_string(_xml(home, camera))
        self._data = mujoco.MjData(self._model)
        size = camera.width, camera.height
        self._gl = mujoco.GLContext(*size)
        self._gl.make_current()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(self._model, 6000)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._view = mujoco.MjvCamera()
        self._view.type, self._view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
        self._option = mujoco.MjvOption()
        self._rect = mujoco.MjrRect(0, 0, *size)
        self.move()

    def move(self) -> None:
        """Put all objects where the home has them now; what is gone, far away."""
        for item in self._home.items:
            row = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_BODY, f"item{item.number}")
            away = np.array([0.0, 0.0, -50.0]) if item.number in self._home.gone else 0.0
            self._model.body_pos[row] = item.position + away
            mujoco.mju_mat2Quat(self._model.body_quat[row], item.rotation.ravel())

    def close(self) -> None:
        """Free the graphics memory."""
        self._context.free()
        self._gl.free()

    def render(self, T_world_camera: np.ndarray) -> np.ndarray:
        """RGB (h, w, 3) uint8."""
        self._gl.make_current()
        self._aim(T_world_camera)
        mujoco.mjr_render(self._rect, self._scene, self._context)
        rgb = np.empty((*self._size, 3), np.uint8)
        mujoco.mjr_readPixels(rgb, None, self._rect, self._context)
        return rgb[::-1].copy()

    def _aim(self, T_world_camera: np.ndarray) -> None:
        self._model.cam_pos[0] = T_world_camera[:3, 3]
        # MuJoCo's camera looks along −z with y up.
        rotation = T_world_camera[:3, :3] * [1.0, -1.0, -1.0]
        mujoco.mju_mat2Quat(self._model.cam_quat[0], np.ascontiguousarray(rotation).ravel())
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        mujoco.mjv_updateScene(
            self._model, self._data, self._option, None, self._view,
            mujoco.mjtCatBit.mjCAT_ALL, self._scene,
        )  # fmt: skip


def _xml(home: Home, camera: Intrinsics) -> str:
    """The home as a MuJoCo model: a body for each object."""
    degrees = 2 * math.degrees(math.atan(camera.height / 2 / camera.fy))
    meshes, bodies = [], []
    shade = np.random.default_rng(len(home.items)).uniform(0.55, 0.85, 3)
    for box in home.walls:
        bodies.append(_geom("box", (box[1] - box[0]) / 2, box.mean(0), None, shade))
    x0, y0, x1, y1 = home.extent()
    half, middle = ((x1 - x0) / 2, (y1 - y0) / 2), ((x0 + x1) / 2, (y0 + y1) / 2)
    for z, colour in ((-0.05, shade * [0.6, 0.5, 0.4]), (2.55, np.array([0.85] * 3))):
        bodies.append(_geom("box", (*half, 0.05), (*middle, z), None, colour))
    for item in home.items:
        geoms = []
        for index, part in enumerate(item.parts):
            if not part.visible:
                continue
            material = item.materials[part.material]
            colour = 0.7 * np.array(material.albedo) + 0.3 * np.array(material.second)
            if part.shape == "lathe":
                name = f"m{item.number}_{index}"
                mesh = part.mesh
                points = " ".join(f"{v:.5f}" for v in mesh.vertices.ravel())
                faces = " ".join(map(str, mesh.faces.ravel()))
                meshes.append(
                    f'<mesh name="{name}" vertex="{points}" face="{faces}" inertia="shell"/>'
                )
                geoms.append(f'<geom type="mesh" mesh="{name}" rgba="{_numbers(colour)} 1"/>')
            else:
                geoms.append(_geom(part.shape, part.size, part.position, part.rotation, colour))
        bodies.append(f'<body name="item{item.number}">{"".join(geoms)}</body>')
    lights = "".join(
        f'<light pos="{(a + c) / 2} {(b + d) / 2} 2.3" dir="0 0 -1" cutoff="90" exponent="1"'
        ' diffuse="0.5 0.5 0.5" attenuation="0.6 0.15 0.1" castshadow="false"/>'
        for a, b, c, d in home.rects
    )
    extent = 10.0
    return (
        f'<mujoco><statistic extent="{extent}"/><visual><map znear="{NEAR_M / extent}" '
        f'zfar="{FAR_M / extent}"/><global offwidth="{camera.width}" offheight="{camera.height}"/>'
        '<headlight ambient="0.35 0.35 0.35" diffuse="0.3 0.3 0.3"/></visual>'
        f"<asset>{''.join(meshes)}</asset><worldbody>{lights}"
        f'<camera name="robot" fovy="{degrees}"/>{"".join(bodies)}</worldbody></mujoco>'
    )


def _geom(shape: str, size, place, rotation, colour) -> str:
    quaternion = np.array([1.0, 0, 0, 0])
    if rotation is not None:
        mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).ravel())
    return (
        f'<geom type="{shape}" size="{_numbers(size)}" pos="{_numbers(place)}" '
        f'quat="{_numbers(quaternion)}" rgba="{_numbers(np.clip(colour, 0, 1))} 1"/>'
    )


def _numbers(values) -> str:
    return " ".join(f"{value:.5f}" for value in values)
