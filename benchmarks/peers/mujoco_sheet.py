# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""MuJoCo's flex: an isotropic elastic membrane instead of springs, stepped implicitly."""

from __future__ import annotations

from typing import Any

import numpy as np

#: Thickness that turns the sheet's modulus [N/m] into Young's [Pa]; so thin that bending hardly resists.
_THICKNESS = 1e-3

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


class Engine:
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
            # Stress in proportion to the strain's rate: the time that the springs' damping over their stiffness is.
            damping=float(sheet["damping"][0] / along),
            # Its grid counts y upwards; our rows lead down.
            pins=_numbers(np.stack([column, self._rows - 1 - row], axis=1).ravel()),
        )
        self._model = mujoco.MjModel.from_xml_string(text)
        self._model.dof_damping[:] = float(sheet["drag"]) * sheet["masses"][0]
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)

    def advance(self, steps: int) -> None:
        """Take so many steps."""
        for _ in range(steps):
            self._mujoco.mj_step(self._model, self._data)

    def positions(self) -> Any:
        """Positions [m]."""
        self._mujoco.mj_kinematics(self._model, self._data)
        self._mujoco.mj_flex(self._model, self._data)
        grid = self._data.flexvert_xpos.reshape(self._columns, self._rows, 3)
        return np.ascontiguousarray(grid[:, ::-1].transpose(1, 0, 2)).reshape(-1, 3)

    def remarks(self) -> list[str]:
        """What it warned of."""
        kinds = self._mujoco.mjtWarning
        given = [(kinds(i).name, int(one.number)) for i, one in enumerate(self._data.warning) if one.number]
        return [f"warned {name} {count} times" for name, count in given]


def _numbers(values: Any) -> str:
    return " ".join(repr(value) for value in np.asarray(values).tolist())
