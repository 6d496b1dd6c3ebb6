"""Pictures and videos: they show the classes, disturb nothing and reach the disk."""

import contextlib
import gc
import sys
import types

import imageio.v3 as imageio
import mujoco
import numpy as np
import pytest

from sims.pouring import PouringWorld
from sims.pouring.census import SphereClass
from sims.pouring.rendering import COLOURS, Camera, RecordedWorld, film, strip, viewer, write_picture, write_video


@pytest.fixture
def world():
    world = PouringWorld("wat", 0.25, receiver_x=0.6)
    world.reset(0)
    return world


def test_pictures_show_the_classes_and_disturb_nothing(world):
    camera = Camera(world, 160, 160)
    before = world.behaviour.simulation.save().physics
    first = camera.picture()
    assert first.shape == (160, 160, 3)
    assert first.dtype == np.uint8
    assert np.array_equal(first, camera.picture())
    world.behaviour.census.classes[:] = SphereClass.SPILLED
    reddened = camera.picture().astype(int) - first
    assert (reddened[..., 0] > 50).sum() > 100
    assert (reddened[..., 2] < -50).sum() > 100
    assert np.array_equal(world.behaviour.simulation.save().physics, before)
    camera.close()


def test_a_camera_follows_its_world_into_another_scene(world):
    camera = Camera(world, 160, 160)
    first = camera.picture()
    world._mouth = (0.11, 0.11)
    world.reset(0)
    assert not np.array_equal(camera.picture(), first)
    camera.close()


# imageio's reader leaves the pipes to its ffmpeg process for the collector to close.
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_film_becomes_a_strip_and_a_video(world, tmp_path):
    camera = Camera(world, 160, 160)
    world.execute("start", {"grasp_ratio": 0.5})
    with film(world, camera, every=10) as frames:
        world.execute("grasped", {})
    assert not world.behaviour.simulation.listeners
    assert len(frames) > 3
    assert strip(frames, 4).shape == (160, 640, 3)
    write_picture(tmp_path / "strip.png", strip(frames, 4))
    assert imageio.imread(tmp_path / "strip.png").shape == (160, 640, 3)
    for ending in ("mp4", "gif"):
        write_video(tmp_path / f"film.{ending}", frames, fps=10)
        assert len(list(imageio.imiter(tmp_path / f"film.{ending}"))) == len(frames)
    with pytest.raises(ValueError, match=r"ends in neither .mp4 nor .gif"):
        write_video(tmp_path / "film.avi", frames, fps=10)
    camera.close()
    gc.collect()  # here, so that what the collector says is ignored here


def test_an_attempt_is_filmed_as_it_was_made():
    actions = {"grasp_ratio": 0.5, "pour_position": (-0.2, 0.4), "tilt_rate": 0.02, "search_rate": 0.005}
    world = PouringWorld("wat", 0.25, target=0.05, receiver_x=0.6)
    recorded = RecordedWorld(world)
    recorded.reset(0)
    while world.node != "poured":
        recorded.execute(world.node, actions, {"skill": "tip"})
    poured, metrics = world.save(), world.metrics
    (attempt,) = recorded.attempts
    assert attempt.selections == {"skill": "tip"}
    recorded.reset(1)
    assert not recorded.attempts
    frames = recorded.film(attempt, every=100, size=64)
    assert len(frames) > 3
    assert frames[0].shape == (64, 64, 3)
    assert world.metrics == metrics
    assert np.array_equal(world.save().behaviour.simulation.physics, poured.behaviour.simulation.physics)


def test_a_missing_screen_is_named(world, monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(RuntimeError, match="there is no screen"), viewer(world):
        pass


class FakeWindow:
    """Stands for MuJoCo's window, which needs a screen: it counts what it shows and closes after 5 pictures."""

    def __init__(self, model, data):
        self.model, self.data = model, data
        self.cam = mujoco.MjvCamera()
        self.synced = 0

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def is_running(self):
        return self.synced < 5

    def lock(self):
        return contextlib.nullcontext()

    def sync(self):
        self.synced += 1


def test_the_viewer_shows_copies_in_colour_until_it_is_closed(world, monkeypatch):
    fake = types.SimpleNamespace(launch_passive=lambda model, data, **panels: FakeWindow(model, data))
    monkeypatch.setitem(sys.modules, "mujoco.viewer", fake)
    monkeypatch.setattr(mujoco, "viewer", fake, raising=False)
    monkeypatch.setenv("DISPLAY", ":0")
    simulation = world.behaviour.simulation
    world.execute("start", {"grasp_ratio": 0.5})
    with viewer(world) as window:
        assert np.array_equal(window.data.qpos, simulation.data.qpos)
        assert window.data.qpos is not simulation.data.qpos
        assert (window.model.geom_rgba[-1] == np.float32(COLOURS[SphereClass.SOURCE])).all()
        assert (simulation.model.geom_rgba[-1] != window.model.geom_rgba[-1]).any()
        assert window.synced == 1
        world.execute("grasped", {})
    assert window.synced == 5
    assert not simulation.listeners
