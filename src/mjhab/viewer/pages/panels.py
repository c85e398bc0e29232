"""The panels of the page: controls, plan, forces, rewards, checks, camera images, curves, time line, failures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from html import escape
from typing import Any

import numpy as np
import viser
from viser import uplot

from mjhab.core.timing import STEP_SECONDS
from mjhab.data.store.schema import STORED_CHECKS
from mjhab.viewer.pages.timeline import (
    TONE_COLORS,
    WIDTH,
    about_html,
    actors_html,
    gauge_html,
    plan_html,
    terms_html,
    timeline_svg,
)
from mjhab.viewer.sources.track import Track

SPEEDS = {
    "0.1×": 0.1,
    "0.25×": 0.25,
    "0.5×": 0.5,
    "1×": 1.0,
    "2×": 2.0,
    "as fast as it can": math.inf,
}
# More than a curve of 320 px can show.
MAX_PLOT_POINTS = 500
SIDE_WIDTH_PX = 320
TIMELINE_WIDTH_PX = WIDTH
"""Width of the time line; it fits between the docked panels of a page of 1,280 px."""
TIMELINE_HEIGHT_PX = 175
"""A panel that grows after it was placed at the bottom of the page grows out of the page."""
HELP = """**By hand** (or a gamepad)
| | |
|---|---|
| W S · A D | drive, turn |
| I K · J L · U O | gripper forward, left, up |
| R F · T G · Y H | roll, pitch, yaw |
| Space | open, close |
| handle | the gripper follows |
| C, held | act in place of the policy |
| Z X · arrows | torso, head |
"""


class Panels:
    """Create the panels of a viser server and fill them; input in a page calls the callbacks.

    Args:
        server: the server of the page.
        choices: names of the worlds or recorded episodes that can be watched.
        policies: specifications of the policies that can be chosen; empty for recorded episodes.
        others: whether other policies can be typed in, which may be files of this machine.
        on: callbacks by name: "choose" (choice), "policy" (specification), "play" (bool), "step", "speed" (factor),
            "scrub" (index of a state), "live", "restart", "next", "expert_plan" (bool), "hand" (bool), "grip",
            "finish".
    """

    def __init__(
        self,
        server: viser.ViserServer,
        choices: Sequence[str],
        policies: Sequence[str],
        others: bool,
        on: dict[str, Callable[..., None]],
    ) -> None:
        self._gui = server.gui
        self._on = on
        self._live = bool(policies)
        self._track: Track | None = None
        self._drawn: tuple[Any, ...] = ()
        self._images: dict[str, Any] = {}
        # Floating, its end, with the keys of "By hand", would lie below the time line.
        self._gui.main_panel.dock_right()
        self._gui.main_panel.set_width(SIDE_WIDTH_PX)
        self._build_main(choices, policies, others)
        self._build_side()
        self._build_timeline()

    def _build_main(
        self, choices: Sequence[str], policies: Sequence[str], others: bool
    ) -> None:
        gui = self._gui
        self._problem = gui.add_html("", visible=False)
        self._title = gui.add_html(
            '<i style="padding:0 8px">The home is being made ready.</i>'
        )
        self._choice = gui.add_dropdown(
            "World" if self._live else "Episode", tuple(choices)
        )
        _when_changed(self._choice, self._on["choose"])
        if policies:
            self._policy = gui.add_dropdown("Policy", tuple(policies))
            _when_changed(self._policy, self._on["policy"])
        if policies and others:
            other = gui.add_text(
                "Another",
                "",
                hint="as for --policy: a checkpoint, FILE.py:CLASS, ws://host:port",
            )
            gui.add_button("Let it act", icon=viser.Icon.ROBOT).on_click(
                lambda _: self._take_policy(other.value.strip())
            )
        self._play = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self._play.on_click(lambda _: self._on["play"](self._play.label == "Play"))
        gui.add_button("Single step", icon=viser.Icon.PLAYER_TRACK_NEXT).on_click(
            lambda _: self._on["step"]()
        )
        if self._live:
            gui.add_button("Back to now", icon=viser.Icon.PLAYER_SKIP_FORWARD).on_click(
                lambda _: self._on["live"]()
            )
        speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1×")
        _when_changed(speed, lambda name: self._on["speed"](SPEEDS[name]))
        self._follow = gui.add_checkbox(
            "Follow", False, hint="the camera follows the robot"
        )
        gui.add_button("Again", icon=viser.Icon.REFRESH).on_click(
            lambda _: self._on["restart"]()
        )
        gui.add_button("Next episode", icon=viser.Icon.ARROW_RIGHT).on_click(
            lambda _: self._on["next"]()
        )
        plan = gui.add_checkbox(
            "Expert plan",
            False,
            hint="path, base placement and grasps that the expert plans",
        )
        _when_changed(plan, self._on["expert_plan"])
        if self._live:
            self._build_hand()

    def _take_policy(self, spec: str) -> None:
        """Choose a policy that was typed in, and add it to the list."""
        if not spec:
            return
        if spec not in self._policy.options:
            self._policy.options = (*self._policy.options, spec)
        self._policy.value = spec
        self._on["policy"](spec)

    def _build_hand(self) -> None:
        with self._gui.add_folder("By hand"):
            self._hand = self._gui.add_button("Take over", icon=viser.Icon.HAND_STOP)
            self._hand.on_click(
                lambda _: self._on["hand"](self._hand.label == "Take over")
            )
            self._grip = self._gui.add_button(
                "Open or close the gripper",
                icon=viser.Icon.GRIP_HORIZONTAL,
                visible=False,
            )
            self._grip.on_click(lambda _: self._on["grip"]())
            self._finish = self._gui.add_button("End and keep the episode", visible=False)
            self._finish.on_click(lambda _: self._on["finish"]())
            self._recording = self._gui.add_html("")
            self._gui.add_markdown(HELP)

    def _build_side(self) -> None:
        gui = self._gui
        panel = gui.add_panel()
        with panel.add_tab("Robot", viser.Icon.ROBOT):
            self._cameras = gui.add_folder("Cameras")
            self._plan = gui.add_html("")
            self._gauges = gui.add_html("")
            self._terms = gui.add_html("")
            self._checks = gui.add_html("")
        with panel.add_tab("Curves", viser.Icon.CHART_LINE):
            self._force_plot = self._add_plot("force [N]", ("robot force",))
            self._sum_plot = self._add_plot(
                "cumulative force [N x steps]", ("sum", "limit")
            )
            self._reward_plot = self._add_plot("reward", ("reward",))
        panel.dock_left()
        panel.set_width(SIDE_WIDTH_PX)

    def _add_plot(self, title: str, names: Sequence[str]) -> Any:
        colors = ("#3b82f6", "#dc2626")
        series = [uplot.Series(label="step")]
        series += [
            uplot.Series(label=name, stroke=color, width=2)
            for name, color in zip(names, colors, strict=False)
        ]
        empty = tuple(np.zeros(2) for _ in series)
        scales = {"x": uplot.Scale(time=False)}
        return self._gui.add_uplot(
            empty, tuple(series), title=title, scales=scales, height=170
        )

    def _build_timeline(self) -> None:
        panel = self._gui.add_panel()
        with panel.add_tab("Time line", viser.Icon.TIMELINE):
            self._line = self._gui.add_html("")
            self._actors = self._gui.add_html("")
            self._slider = self._gui.add_slider(
                "step", min=0, max=1, step=1, initial_value=0
            )
            self._slider.on_update(self._scrub)
            self._events = self._gui.add_html("")
        panel.float(x=12, y=-12, width=TIMELINE_WIDTH_PX, height=TIMELINE_HEIGHT_PX)

    def _scrub(self, event: Any) -> None:
        # Updates by the server itself come without a client.
        if event.client is not None:
            self._on["scrub"](int(event.target.value))

    @property
    def follows(self) -> bool:
        """Whether "Follow" is checked: the camera of the page moves along with the robot."""
        return bool(self._follow.value)

    def show_images(self, pictures: dict[str, np.ndarray]) -> None:
        """Show the images (h, w, 3) uint8 of the robot's cameras, by name; new names rebuild the image widgets."""
        if pictures.keys() != self._images.keys():
            for image in self._images.values():
                image.remove()
            with self._cameras:
                self._images = {
                    name: self._gui.add_image(
                        picture,
                        label=name.replace("_", " "),
                        format="jpeg",
                        jpeg_quality=80,
                    )
                    for name, picture in pictures.items()
                }
            return
        for name, picture in pictures.items():
            self._images[name].image = picture

    def show_problem(self, text: str) -> None:
        """Show a message about a failure; hide it if ``text`` is ""."""
        style = (
            f"background:{TONE_COLORS['bad']};color:white;padding:8px;border-radius:6px"
        )
        _fill(self._problem, f'<div style="{style}">{escape(text)}</div>' if text else "")
        if self._problem.visible != bool(text):
            self._problem.visible = bool(text)

    def show_playing(self, playing: bool) -> None:
        """Label the play button "Pause" while playing, else "Play"."""
        name = "Pause" if playing else "Play"
        if self._play.label != name:
            self._play.label = name
            self._play.icon = (
                viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY
            )

    def show_choice(self, choice: str) -> None:
        """Select what is watched in its menu; "" changes nothing."""
        if choice and self._choice.value != choice:
            self._choice.value = choice

    def show_hand(self, driving: bool, recording: str) -> None:
        """Show whether the watched world is teleoperated, and the message about recording ("" for none)."""
        if not self._live:
            return
        name = "Give back" if driving else "Take over"
        if self._hand.label != name:
            self._hand.label = name
        if self._grip.visible != driving:
            self._grip.visible = driving
        if self._finish.visible != bool(recording):
            self._finish.visible = bool(recording)
        _fill(
            self._recording, f'<small style="padding:0 8px">{escape(recording)}</small>'
        )

    def show(self, track: Track, step: int) -> None:
        """Fill all widgets that depend on the episode and the state at index ``step``."""
        moment = track.moments[step]
        key = (id(track), track.last, step, track.over, len(track.events))
        # The panels are filled eight times a second, mostly with what they show already.
        if key == self._drawn:
            return
        if self._drawn[:2] != key[:2]:
            self._slider.max = max(track.last, 1)
            self._fill_plots(track)
        self._drawn = key
        if int(self._slider.value) != step:
            self._slider.value = step
        _fill(self._line, timeline_svg(track, step))
        _fill(self._actors, actors_html(track, step))
        _fill(self._title, about_html(track, step))
        _fill(self._plan, f'<div style="padding:0 8px">{plan_html(track, step)}</div>')
        forces = gauge_html("robot force", moment.robot_force, math.inf, "N")
        forces += gauge_html(
            "cumulative force", moment.cumulative_force, track.limit_at(step), "N x steps"
        )
        _fill(self._gauges, f'<div style="padding:0 8px">{forces}</div>')
        terms = terms_html(track.terms_at(step), moment.reward)
        _fill(self._terms, f'<div style="padding:0 8px">{terms}</div>')
        _fill(self._checks, _checks_html(moment.checks))
        _fill(self._events, _events_html(track, step))

    def _fill_plots(self, track: Track) -> None:
        rows = np.unique(np.linspace(0, track.last, MAX_PLOT_POINTS).astype(int))
        moments = [track.moments[row] for row in rows]
        limits = np.array([track.limit_at(int(row)) for row in rows])
        # uPlot leaves a gap for nan, and draws nothing at all for infinity.
        limits[np.isinf(limits)] = np.nan
        steps = rows.astype(float)
        # A curve needs two points.
        if len(steps) < 2:
            return
        self._force_plot.data = (steps, np.array([m.robot_force for m in moments]))
        sums = np.array([m.cumulative_force for m in moments])
        self._sum_plot.data = (steps, sums, limits)
        self._reward_plot.data = (steps, np.array([m.reward for m in moments]))


def _when_changed(handle: Any, tell: Callable[[Any], object]) -> None:
    """Call ``tell`` with the value of a widget when it is changed in a page, not by the server."""

    def changed(event: Any) -> None:
        if event.client is not None:
            tell(event.target.value)

    handle.on_update(changed)


def _fill(handle: Any, content: str) -> None:
    # Each assignment is a message to all pages.
    if handle.content != content:
        handle.content = content


def _checks_html(checks: np.ndarray) -> str:
    marks = []
    for name, value in zip(STORED_CHECKS, checks.tolist(), strict=True):
        color = TONE_COLORS["good"] if value else "#8884"
        marks.append(
            f'<span style="background:{color};border-radius:8px;padding:1px 7px;margin:1px;display:inline-block;'
            f'font-size:11px">{escape(name.replace("_", " "))}</span>'
        )
    return f'<div style="padding:4px 8px">{"".join(marks)}</div>'


def _events_html(track: Track, step: int) -> str:
    """HTML of the last six events up to a state, the newest first."""
    newest = track.events_until(step)[-6:][::-1]
    shown = " · ".join(
        f"{escape(name.replace('_', ' '))} {at * STEP_SECONDS:.2f} s"
        for at, name in newest
    )
    return f'<div style="font-size:12px;padding:0 8px;min-height:1.5em">{shown}</div>'
