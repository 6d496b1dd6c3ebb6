"""Pictures and videos of an episode, which need no screen, and MuJoCo's viewer where there is one."""

from __future__ import annotations

import copy
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import imageio.v3 as imageio
import mujoco
import numpy as np

from sims.pouring.behaviour import Phase
from sims.pouring.census import SphereClass
from sims.pouring.geometry import SPHERES
from sims.pouring.observation import Observation
from sims.pouring.scene import CONTROL_STEP
from sims.pouring.simulation import Simulation
from sims.pouring.world import Actions, PouringWorld, Selections, WorldState

VIDEO_ENDINGS = (".mp4", ".gif")
COLOURS = {
    SphereClass.SOURCE: (0.20, 0.45, 0.95, 1.0),
    SphereClass.FLOWING: (1.00, 0.75, 0.05, 1.0),
    SphereClass.RECEIVED: (0.10, 0.65, 0.30, 1.0),
    SphereClass.SPILLED: (0.90, 0.10, 0.10, 1.0),
    SphereClass.BOUNCED: (0.55, 0.35, 0.75, 1.0),
}


class Window(Protocol):
    """What a viewer's window can be asked."""

    def is_running(self) -> bool:
        """Whether nobody has closed it."""


class Camera:
    """Draws a world's present moment from the side, spheres coloured by class.

    Args:
        world: What to draw.
        width: Of the pictures [pixels].
        height: Of the pictures [pixels].
    """

    def __init__(self, world: PouringWorld, width: int = 480, height: int = 480) -> None:
        self._world = world
        self._size = (height, width)
        self._renderer: mujoco.Renderer | None = None
        self._data: mujoco.MjData | None = None

    def picture(self) -> np.ndarray:
        """Return the present moment as (height, width, 3) bytes."""
        simulation = self._world.behaviour.simulation
        renderer, data = self._prepare(simulation)
        data.qpos[:] = simulation.data.qpos
        mujoco.mj_kinematics(simulation.model, data)
        mujoco.mj_camlight(simulation.model, data)
        view = mujoco.MjvCamera()
        aim(view, simulation)
        renderer.update_scene(data, camera=view)
        paint(renderer.scene, simulation.model, self._world.behaviour.census.classes)
        return renderer.render().copy()

    def _prepare(self, simulation: Simulation) -> tuple[mujoco.Renderer, mujoco.MjData]:
        """Return a renderer for the present model, and data of its own, so that drawing disturbs nothing."""
        if self._renderer is None or self._data is None or self._renderer.model is not simulation.model:
            self.close()
            self._renderer = mujoco.Renderer(simulation.model, *self._size)
            self._data = mujoco.MjData(simulation.model)
        return self._renderer, self._data

    def close(self) -> None:
        """Free what the graphics system holds."""
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = self._data = None


def aim(view: mujoco.MjvCamera, simulation: Simulation) -> None:
    """Look from the side at the receiver and the place where the source pours."""
    view.lookat[:] = [float(simulation.receiver_pose[0]) - 0.2, 0.0, 0.36]
    view.distance, view.azimuth, view.elevation = 1.75, 90.0, -10.0


def paint(scene: mujoco.MjvScene, model: mujoco.MjModel, classes: np.ndarray) -> None:
    """Colour the spheres of a scene by their classes."""
    first = model.ngeom - SPHERES  # the spheres are the last geoms of the model
    for geom in scene.geoms[: scene.ngeom]:
        if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.objid >= first:
            geom.rgba = COLOURS[SphereClass(classes[geom.objid - first])]


@contextmanager
def film(world: PouringWorld, camera: Camera, every: int = 8) -> Iterator[list[np.ndarray]]:
    """Collect a picture of the world every so many control steps while the block runs.

    Args:
        world: Whose present episode is filmed; reset it before.
        camera: That draws it.
        every: Control steps from one picture to the next; 2 fills 20 pictures per unit of simulated time.
    """
    frames: list[np.ndarray] = []
    steps = 0

    def look(simulation: Simulation) -> None:
        nonlocal steps
        if steps % every == 0:
            frames.append(camera.picture())
        steps += 1

    listeners = world.behaviour.simulation.listeners
    listeners.append(look)
    try:
        yield frames
    finally:
        listeners.remove(look)


@dataclass(frozen=True)
class Attempt:
    """An attempt as it began.

    Attributes:
        state: Of the world at "at_receiver".
        actions: Label -> value.
        selections: {"skill": "tip" or "shake"}.
    """

    state: WorldState
    actions: Actions
    selections: Selections


class RecordedWorld:
    """A world that remembers how attempts began, since drawing takes longer than simulating: film afterwards.

    Args:
        world: What to record.

    Attributes:
        attempts: Of the present episode.
    """

    def __init__(self, world: PouringWorld) -> None:
        self._world = world
        self.attempts: list[Attempt] = []

    def reset(self, seed: int) -> Observation:
        """Begin an episode."""
        self.attempts = []
        return self._world.reset(seed)

    def execute(self, node: str, actions: Actions, selections: Selections) -> dict[str, Observation]:
        """Do what leaves a node."""
        if node == Phase.AT_RECEIVER.value:
            self.attempts.append(Attempt(self._world.save(), copy.deepcopy(actions), dict(selections)))
        return self._world.execute(node, actions, selections)

    def film(self, attempt: Attempt, every: int = 12, size: int = 320) -> list[np.ndarray]:
        """Return pictures of an attempt, which is made once more, from "at_receiver" to "poured".

        Args:
            attempt: Whose actions were decided when it began.
            every: Control steps from one picture to the next.
            size: Width and height of the pictures [pixels].
        """
        self._world.restore(attempt.state)
        camera = Camera(self._world, size, size)
        try:
            with film(self._world, camera, every) as frames:
                while self._world.node != Phase.POURED.value:
                    self._world.execute(self._world.node, attempt.actions, attempt.selections)
        finally:
            camera.close()
        return frames

    def close(self) -> None:
        """Let go of the world."""
        self._world.close()


def strip(frames: Sequence[np.ndarray], count: int = 6) -> np.ndarray:
    """Return `count` pictures, evenly spread over the frames, side by side as one picture."""
    chosen = np.linspace(0, len(frames) - 1, count).round().astype(int)
    return np.concatenate([frames[index] for index in chosen], axis=1)


def write_picture(path: str | Path, picture: np.ndarray) -> None:
    """Write a picture; the ending of the name says how."""
    imageio.imwrite(path, picture)


def write_video(path: str | Path, frames: Sequence[np.ndarray], fps: float) -> None:
    """Write frames as .mp4 or .gif.

    Args:
        path: Where to; the ending says which.
        frames: Pictures of equal size, with even width and height for .mp4.
        fps: Pictures a second.

    Raises:
        ValueError: The ending is neither .mp4 nor .gif.
    """
    ending = Path(path).suffix
    if ending == ".mp4":
        imageio.imwrite(path, np.stack(frames), fps=fps, codec="libx264", macro_block_size=2)
    elif ending == ".gif":
        imageio.imwrite(path, np.stack(frames), duration=1000.0 / fps, loop=0)
    else:
        raise ValueError(f"video: {str(path)!r} ends in neither .mp4 nor .gif; choose one of these")


@contextmanager
def viewer(world: PouringWorld) -> Iterator[Window]:
    """Show the world in MuJoCo's interactive viewer while the block runs; this needs a screen.

    One unit of simulated time takes a second while the window is open. Closing it lets the block run on
    unseen. The viewer draws copies, so that its buttons and the mouse disturb nothing.

    Args:
        world: Whose present episode is shown; reset it before.

    Raises:
        RuntimeError: There is no screen.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        # MuJoCo would end the whole process instead of raising.
        raise RuntimeError("viewer: there is no screen (DISPLAY is not set); use film and write_video")
    import mujoco.viewer  # it needs a screen already when it is imported

    simulation = world.behaviour.simulation
    model = copy.copy(simulation.model)
    data = mujoco.MjData(model)
    with mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False) as window:
        aim(window.cam, simulation)
        shown = time.perf_counter()

        def show(simulation: Simulation) -> None:
            nonlocal shown
            if not window.is_running():
                return
            with window.lock():
                data.qpos[:] = simulation.data.qpos
                model.geom_rgba[-SPHERES:] = [COLOURS[SphereClass(one)] for one in world.behaviour.census.classes]
                mujoco.mj_kinematics(model, data)
            window.sync()
            time.sleep(max(0.0, shown + CONTROL_STEP - time.perf_counter()))
            shown = time.perf_counter()

        show(simulation)
        simulation.listeners.append(show)
        try:
            yield window
        finally:
            simulation.listeners.remove(show)
