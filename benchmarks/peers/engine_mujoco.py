# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Engine MuJoCo flex: an elastic shell."""

from __future__ import annotations

from typing import Any

import numpy as np

#: Thickness that converts the sheet's modulus [N/m] to Young's [Pa]; small, for a low bending stiffness [m].
_THICKNESS = 1e-3
#: Mass [kg] and damping [N s/m] of each pad; mass added to a carried particle [kg].
_PAD_MASS, _PAD_DAMPING, _CARRIER = 0.05, 10.0, 100.0

_MODEL = """
<mujoco>
  <option timestep="{step!r}" integrator="discrete" gravity="{gravity}"/>
  <size memory="4G"/>
  <worldbody>
    <flexcomp name="sheet" type="grid" dim="2" count="{columns} {rows} 1" spacing="{h!r} {h!r} {h!r}"
              pos="{middle}" mass="{mass!r}" radius="1e-3">
      <edge equality="false"/>
      <elasticity young="{young!r}" poisson="0" thickness="{thickness!r}" damping="{damping!r}" elastic2d="both"/>
      <contact selfcollide="none" contype="0" conaffinity="0"/>
      <pin grid="{pins}"/>
    </flexcomp>
  </worldbody>
</mujoco>
"""
_CONTACT_MODEL = """
<mujoco>
  <option timestep="{step!r}" cone="elliptic" gravity="{gravity}" integrator="discrete" solver="{solver}"
          tolerance="1e-6" iterations="400">
    <flag autoreset="disable" ipc="{ipc}"/>
  </option>
  <size memory="4G"/>
  <default><geom solref="0.003 1" friction="{friction!r} 0.005 0.0001" condim="3"/></default>
  <worldbody>
    {solids}
    <flexcomp name="sheet" type="direct" dim="2" point="{points}" element="{elements}" mass="1" radius="{radius!r}">
      <contact selfcollide="{own}" condim="3" friction="{friction!r} 0.005 0.0001"
               solref="0.01 1" solimp=".95 .99 .0001"/>
      <elasticity young="{young!r}" poisson="0" thickness="{thickness!r}" damping="{damping!r}" elastic2d="both"/>
      {pins}
    </flexcomp>
  </worldbody>
</mujoco>
"""
_PAD = """<body pos="{place}"><joint type="slide" axis="0 1 0" damping="{damping!r}"/>
    <geom type="box" size="{size}" mass="{mass!r}"/></body>"""


class MujocoEngine:
    """See `runner`; one variant."""

    distributions = ("mujoco",)

    def __init__(self, sheet: dict[str, Any], step: float, variant: str) -> None:
        import mujoco

        self._mujoco = mujoco
        self._rows, self._columns = int(sheet["rows"]), int(sheet["columns"])
        row, column = np.divmod(np.flatnonzero(sheet["anchored"]), self._columns)
        middle = 0.5 * (sheet["positions"].min(axis=0) + sheet["positions"].max(axis=0))
        along = sheet["stiffness"][0]
        text = _MODEL.format(
            step=float(step),
            gravity=_numbers(sheet["gravity"]),
            rows=self._rows,
            columns=self._columns,
            h=float(sheet["edge_lengths"][0]),
            middle=_numbers(middle),
            mass=float(sheet["masses"].sum()),
            young=float(along / _THICKNESS),
            thickness=_THICKNESS,
            # Stress proportional to the strain rate, with the springs' damping over their stiffness as time constant.
            damping=float(sheet["damping"][0] / along),
            # Its rows go up along y, those of the sheet go down.
            pins=_numbers(np.stack([column, self._rows - 1 - row], axis=1).ravel()),
        )
        self._model = mujoco.MjModel.from_xml_string(text)
        self._model.dof_damping[:] = float(sheet["drag"]) * sheet["masses"][0]
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)

    def advance(self, steps: int) -> None:
        """Take some steps."""
        for _ in range(steps):
            self._mujoco.mj_step(self._model, self._data)

    def positions(self) -> Any:
        """Positions [m], (n, 3)."""
        grid = self._vertices().reshape(self._columns, self._rows, 3)
        return np.ascontiguousarray(grid[:, ::-1].transpose(1, 0, 2)).reshape(-1, 3)

    def _vertices(self) -> Any:
        self._mujoco.mj_kinematics(self._model, self._data)
        self._mujoco.mj_flex(self._model, self._data)
        return self._data.flexvert_xpos

    def remarks(self) -> list[str]:
        """Return its warnings."""
        kinds = self._mujoco.mjtWarning
        warnings = enumerate(self._data.warning)
        return [f"warned {kinds(i).name} {int(warning.number)} times" for i, warning in warnings if warning.number]


class MujocoContactEngine(MujocoEngine):
    """Scenes with contact; variants cg and newton, its solvers, and ipc, its intersection-free contact."""

    def __init__(self, sheet: dict[str, Any], step: float, variant: str) -> None:
        import mujoco

        self._mujoco = mujoco
        # A shell of this thickness has the bending modulus.
        thickness = float(np.sqrt(12.0 * sheet["bending"] / sheet["modulus"]))
        anchored = np.flatnonzero(sheet["anchored"])
        text = _CONTACT_MODEL.format(
            step=float(step),
            gravity=_numbers(sheet["gravity"]),
            solver="CG" if variant == "cg" else "Newton",
            ipc="enable" if variant == "ipc" else "disable",
            friction=float(sheet["friction"]),
            solids=_solids(sheet),
            points=_numbers(sheet["positions"].ravel()),
            elements=_numbers(sheet["triangles"].ravel()),
            radius=float(sheet["thickness"]),
            own="auto" if sheet["own"] else "none",
            young=float(sheet["modulus"]) / thickness,
            thickness=thickness,
            damping=float(sheet["retardation"]),
            pins=f'<pin id="{_numbers(anchored)}"/>' if len(anchored) else "",
        )
        model = mujoco.MjModel.from_xml_string(text)
        # Masses of the product: smaller at the border.
        bodies, free = model.flex_vertbodyid, ~sheet["anchored"]
        model.body_mass[bodies[free]] = sheet["masses"][free]
        for body, mass in zip(bodies[free].tolist(), sheet["masses"][free].tolist(), strict=True):
            first = model.body_dofadr[body]
            model.dof_damping[first : first + 3] = float(sheet["drag"]) * mass
        self._model, self._data = model, mujoco.MjData(model)
        mujoco.mj_setConst(model, self._data)
        self._held = model.body_dofadr[bodies[sheet["held"]]][:, None] + np.arange(3)
        self._add_inertia(_CARRIER)
        self._step, self._start = step, sheet["positions"][sheet["held"]]
        self._path: Any = iter(())
        self._pads = np.zeros((0, 3))
        if sheet["kind"] == "pinch":
            self._pads = sheet["pad_places"]
            # The first joints are those of the pads.
            self._data.qfrc_applied[:2] = -np.sign(self._pads[:, 1]) * float(sheet["force"])
        mujoco.mj_forward(model, self._data)

    def _add_inertia(self, mass: float) -> None:
        """Add mass [kg] to the held particles, whose inertia the model also caches."""
        self._model.dof_armature[self._held] += mass
        self._model.dof_M0[self._held] += mass

    def lead(self, begin: Any, end: Any, steps: int) -> None:
        """Move held particles in the next steps."""
        self._path = iter([begin + (k + 1) / steps * (end - begin) - self._start for k in range(steps)])

    def let_go(self) -> None:
        """Release the held particles."""
        self._add_inertia(-_CARRIER)

    def advance(self, steps: int) -> None:
        """Take some steps."""
        for _ in range(steps):
            target = next(self._path, None)
            if target is not None:
                # The coordinates of a vertex are its displacements.
                self._data.qvel[self._held] = (target - self._data.qpos[self._held]) / self._step
            super().advance(1)

    def positions(self) -> Any:
        """Positions [m], (n, 3)."""
        return self._vertices().copy()

    def pads(self) -> Any:
        """Positions of the pads [m], (pads, 3)."""
        places = self._pads.copy()
        if len(places):
            places[:, 1] += self._data.qpos[:2]
        return places


def _solids(sheet: dict[str, Any]) -> str:
    if sheet["kind"] == "drape":
        return f'<geom type="sphere" size="{float(sheet["radius"])!r}"/>'
    if sheet["kind"] == "fold":
        return '<geom type="plane" size="1 1 0.1"/>'
    size = _numbers(0.5 * sheet["pad_size"])
    settings = {"damping": _PAD_DAMPING, "size": size, "mass": _PAD_MASS}
    return "".join(_PAD.format(place=_numbers(position), **settings) for position in sheet["pad_places"])


def _numbers(values: Any) -> str:
    return " ".join(repr(value) for value in np.asarray(values).tolist())
