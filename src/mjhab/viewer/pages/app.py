"""The viewer: a server whose page shows running worlds or recorded episodes."""

from __future__ import annotations

import contextlib
import io
import json
import math
import threading
import time
from collections.abc import Callable

import numpy as np
import viser

from mjhab.data.store.schema import STORED_CHECKS
from mjhab.layout.layout import Layout
from mjhab.render.layout_scene import build_render_scene
from mjhab.render.models import DrawnHome, home_models
from mjhab.render.pictures.follow_camera import FollowCamera
from mjhab.render.render_scene import RenderScene
from mjhab.serving.server import LOCAL_HOSTS
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.viewer.drawn.cameras import CameraThread
from mjhab.viewer.drawn.glb import HomeFiles, home_digest, home_files
from mjhab.viewer.drawn.handle import PoseHandle
from mjhab.viewer.drawn.posing import PosedWorld, Poser, base_of, between
from mjhab.viewer.drawn.stage import MIN_MOVE, DrawnStage
from mjhab.viewer.pages.gateway import Gateway
from mjhab.viewer.pages.panels import Panels
from mjhab.viewer.pages.playhead import Playhead
from mjhab.viewer.sources.hand_input import GRIPPER_KEY, HOLD_KEY, KEYS, REST_KEY
from mjhab.viewer.sources.source import ViewSource
from mjhab.viewer.sources.track import Track

FRAME_SECONDS = 1.0 / 40.0
PANEL_SECONDS = 0.12
CAMERA_SECONDS = 0.12
HOLD_SECONDS = 120.0
"""Longest time that an open page may take to draw the home before the first episode begins all the same [s]."""
DRAWN = '{"drawn":true}'
"""Message of `hand.js`: the page shows the home."""
_GRASPED = STORED_CHECKS.index("is_grasped")


class Viewer:
    """Serve a source of episodes until `close`.

    Args:
        source: running worlds or recorded episodes.
        host, port: see `Gateway`.
        cameras: show the images of the robot's cameras.
        hold: keep the first episode at its start until a page has drawn the home, so that a slow browser misses
            nothing; a page that cannot tell gets `HOLD_SECONDS`.

    Attributes:
        port: the port that is listened on.
        frames: number of frames sent.
        first_frame_at: time (`time.perf_counter`) of the first frame; infinite before.
        frame_cpu_s: CPU time spent on poses and marks [s].

    Raises:
        UsageError: see `Gateway`.
    """

    def __init__(
        self,
        source: ViewSource,
        host: str = "localhost",
        port: int = 8080,
        *,
        cameras: bool = True,
        hold: bool = False,
    ) -> None:
        self.source = source
        self.frames = 0
        self.frame_cpu_s = 0.0
        self.first_frame_at = math.inf
        self.problem = ""
        # viser prints its own port, which is not the one to open.
        with contextlib.redirect_stdout(io.StringIO()):
            self._server = viser.ViserServer("127.0.0.1", 0, "mjhab", verbose=False)
        try:
            self._gateway = Gateway(
                self._server.get_port(), host, port, self._hear, source.hand_gone
            )
        except BaseException:
            # Its threads would keep the process alive.
            self._stop_server()
            raise
        self.port = self._gateway.port
        self._server.gui.configure_theme(
            show_logo=False, show_share_button=False, control_width="medium"
        )
        self.playhead = Playhead(source)
        self._start = _HeldStart(self.playhead, hold)
        self.stage = DrawnStage(self._server)
        self._handle = PoseHandle(self._server.scene, source.aim_hand)
        self.panels = Panels(
            self._server,
            source.choices,
            source.policies,
            others=host in LOCAL_HOSTS,
            on=self._start.letting_go(self.playhead.callbacks()),
        )
        self._cameras = CameraThread(self.panels.show_images) if cameras else None
        # Playing slowly shows many frames between the same two states.
        self._poses = _PoseCache()
        self._scene: tuple[CpuSimulator, RenderScene] | None = None
        self._shown: Track | None = None
        self._shown_home = ""
        self._shown_layout: Layout | None = None
        self._sent_hand = ""
        self._base = np.zeros(3)
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="frames", daemon=True)

    @property
    def clients(self) -> int:
        """Number of pages that are open."""
        return len(self._server.get_clients())

    def start(self) -> None:
        """Start the source and the thread that sends frames."""
        self.source.start()
        self._thread.start()

    def _hear(self, message: str) -> None:
        """Take a message of `hand.js`."""
        if message == DRAWN:
            self._start.let_go()
        else:
            self.source.hear_hand(message)

    def close(self) -> None:
        """Stop the thread, the source, the cameras and the servers."""
        self._closing = True
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)
        self.source.close()
        if self._cameras is not None:
            self._cameras.close()
        self._gateway.close()
        self._stop_server()

    def _stop_server(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _run(self) -> None:
        last = time.perf_counter()
        panels_at = cameras_at = 0.0
        while not self._closing:
            now = time.perf_counter()
            try:
                begun = time.thread_time()
                pose = self.frame(now - last)
                # Of this thread: the worlds run in others.
                self.frame_cpu_s += time.thread_time() - begun
                if pose is not None and now - cameras_at > CAMERA_SECONDS:
                    cameras_at = now
                    self._look(pose)
                if now - panels_at > PANEL_SECONDS:
                    panels_at = now
                    self._fill_panels()
                self.problem = ""
            except Exception as error:
                self.problem = f"{type(error).__name__}: {error}"
                self.panels.show_problem(self.problem)
                # An error comes back at every frame, and would fill the log.
                time.sleep(1.0)
            last = now
            time.sleep(max(0.0, FRAME_SECONDS - (time.perf_counter() - now)))

    def frame(self, seconds: float) -> PosedWorld | None:
        """Send the next frame, ``seconds`` of real time after the one before.

        Returns:
            The pose that it shows; None while the source has no state.
        """
        head = self.playhead
        self._start.wait(seconds if self._start.held and self.clients else 0.0)
        head.advance(seconds)
        track = head.track
        if track is None or track.last < 0:
            return None
        sim = self.source.sim
        pose = self._poses.at(sim, track, head.now)
        if track is not self._shown:
            # Sending a home takes a second, and the next episode is often in the same one.
            if not self._shows(sim.layout, track.home):
                self.stage.show(self._home(sim, track.home), pose)
                self._aim(pose, sim, track.home)
            self._shown_home = track.home
            self._shown_layout = sim.layout
            self._shown = track
        self.stage.place(pose)
        self._follow(pose, sim)
        self._mark(track, head.step, pose, sim)
        self._show_handle(pose, sim)
        self.frames += 1
        if math.isinf(self.first_frame_at):
            self.first_frame_at = time.perf_counter()
        return pose

    def _shows(self, layout: Layout, home: str) -> bool:
        """Whether the stage shows a home of a layout: other tasks have other objects there, and other bodies."""
        shown = self._shown_layout
        if shown is None or home != self._shown_home:
            return False
        return shown is layout or home_digest(shown, home) == home_digest(layout, home)

    def _home(self, sim: CpuSimulator, home: str) -> HomeFiles:
        names = [h.name for h in sim.layout.pack.homes]

        def make() -> DrawnHome:
            if self._scene is None or self._scene[0] is not sim:
                scene = build_render_scene(sim.layout, sim.model(home))
                self._scene = (sim, scene)
            return home_models(self._scene[1], names.index(home))

        return home_files(sim.layout, home, make)

    def _aim(self, pose: PosedWorld, sim: CpuSimulator, home: str) -> None:
        """Move the cameras of all pages to the pose of the follow camera (see `FollowCamera`)."""
        eye, target = FollowCamera(sim.model).look(home, base_of(pose, sim))
        self._server.initial_camera.position = eye
        self._server.initial_camera.look_at = target
        for client in self._server.get_clients().values():
            client.camera.position = eye
            client.camera.look_at = target

    def _follow(self, pose: PosedWorld, sim: CpuSimulator) -> None:
        """Translate the cameras of all pages by the motion of the robot's base, if "Follow" is checked."""
        base = pose.pos[sim.addresses.robot_body[sim.layout.robot.base_link]]
        moved = base - self._base
        self._base = base
        if self.panels.follows and np.abs(moved).max() > MIN_MOVE:
            for client in self._server.get_clients().values():
                # Moved along and not aimed anew, so that the view that somebody has turned stays.
                client.camera.position = client.camera.position + moved

    def _mark(self, track: Track, step: int, pose: PosedWorld, sim: CpuSimulator) -> None:
        moment = track.moments[step]
        tcp = pose.pos[sim.addresses.robot_body[sim.layout.robot.tcp]]
        self.stage.mark_grasp(tcp if moment.checks[_GRASPED] else None)
        self.stage.mark_plan(self.source.plan_at(step))
        goal = track.plan[moment.active].goal if moment.active < len(track.plan) else None
        point = np.asarray(goal, float) if goal is not None else np.zeros(0)
        self.stage.mark_goal(point if point.shape == (3,) and point.any() else None)

    def _show_handle(self, pose: PosedWorld, sim: CpuSimulator) -> None:
        """Show the handle of the hand while the newest state of a world that is driven by hand is shown."""
        root = sim.addresses.robot_body[sim.layout.robot.arm_root]
        shown = self.source.hand_pose if self.playhead.following else None
        self._handle.show(np.concatenate([pose.pos[root], pose.quat[root]]), shown)

    def _look(self, pose: PosedWorld) -> None:
        if self._cameras is not None and self.clients and self._shown is not None:
            self._cameras.look(self.source.sim, self._shown_home, pose)

    def _fill_panels(self) -> None:
        cameras = self._cameras.problem if self._cameras is not None else ""
        self.panels.show_problem(self.source.problem or self.problem or cameras)
        self.panels.show_playing(self.playhead.playing)
        self.panels.show_hand(self.source.hand_drives, self.source.recording)
        self._tell_hand(self.source.hand_drives)
        self.panels.show_choice(self.source.choice)
        track = self.playhead.track
        if track is not None and track.last >= 0:
            self.panels.show(track, self.playhead.step)

    def _tell_hand(self, driving: bool) -> None:
        """Tell `hand.js` in all pages whether to send input, and which keys."""
        hold = HOLD_KEY if self.source.is_live else ""
        keys = [*KEYS, GRIPPER_KEY, REST_KEY, hold]
        message = json.dumps({"hand": driving, "keys": keys, "hold": hold})
        if message != self._sent_hand:
            self._sent_hand = message
            self._gateway.tell(message)


class _HeldStart:
    """Hold an episode at its start until a page shows it, or somebody plays it.

    Args:
        playhead: of the episode. hold: whether to hold it; an episode that is paused anyway stays so.
    """

    def __init__(self, playhead: Playhead, hold: bool) -> None:
        self._playhead = playhead
        self._waited_s = 0.0
        self.held = hold and playhead.playing
        if self.held:
            playhead.play(False)

    def let_go(self) -> None:
        """Begin the episode, unless somebody else did."""
        if self.held:
            self.held = False
            self._playhead.play(True)

    def wait(self, seconds: float) -> None:
        """Count the time [s] that a page is open; begin the episode after `HOLD_SECONDS`."""
        self._waited_s += seconds
        if self._waited_s > HOLD_SECONDS:
            self.let_go()

    def letting_go(
        self, callbacks: dict[str, Callable[..., None]]
    ) -> dict[str, Callable[..., None]]:
        """The callbacks of the panels; who plays, steps or scrubs has taken over."""

        def wrapped(name: str) -> Callable[..., None]:
            def call(*args: object) -> None:
                self.held = self.held and name not in ("play", "step", "scrub", "live")
                callbacks[name](*args)

            return call

        return {name: wrapped(name) for name in callbacks}


class _PoseCache:
    """Cache of the poses of the two states around the position of the playhead."""

    def __init__(self) -> None:
        self._sim: CpuSimulator | None = None
        self._poser: Poser | None = None
        self._known: dict[tuple[int, int], PosedWorld] = {}

    def at(self, sim: CpuSimulator, track: Track, now: float) -> PosedWorld:
        """Return the pose at the position ``now`` [control steps] of a track, interpolated between two states."""
        if self._poser is None or sim is not self._sim:
            self._poser = Poser(sim)
            self._sim = sim
        first = min(math.floor(now), track.last)
        second = min(first + 1, track.last)
        known = {}
        for step in (first, second):
            key = (id(track), step)
            found = self._known.get(key)
            known[key] = found or self._poser.pose(track.home, track.moments[step].qpos)
        self._known = known
        share = now - first
        here = known[id(track), first]
        if share <= 0.0 or first == second:
            return here
        return between(here, known[id(track), second], share)
