"""The labeler's controls next to the scene, and the messages above them."""

from __future__ import annotations

import html
import time
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from pgdm.pregrasp.labeler.joint_names import WRIST, Joint
from pgdm.pregrasp.labeler.measures import Metrics
from pgdm.pregrasp.labeler.state import LabelState
from pgdm.sim.contact import FAR_M

PAUSE_S = 1.0
"""Moving the same slider again after a longer pause starts a new step of the undo history."""
_ORDER = (WRIST, "Index", "Middle", "Ring", "Little", "Thumb")
_STEP = 0.1  # of the sliders, mm and degrees
GREEN, _RED, _AMBER = "#2f9e44", "#e03131", "#e8890c"
HANDLES = ("all", "wrist", "fingertips", "none")


@dataclass(frozen=True)
class Commands:
    """Functions that the controls call, in the order of the clicks."""

    set_joint: Callable[[int, float, object], None]
    """Called with the joint's index, its value in m or rad, and the gesture that sets it."""
    preset: Callable[[str], None]
    undo: Callable[[], None]
    redo: Callable[[], None]
    reset: Callable[[], None]
    try_it: Callable[[], None]
    cancel: Callable[[], None]
    save: Callable[[bool], None]
    """Called with True to save even if the hand touches something or a stored pose is replaced."""
    handles: Callable[[str], None]
    solid: Callable[[bool], None]


class Panel:
    """The controls, shared by all open pages.

    Args:
        server: the labeler's server.
        state: the pose to show.
        presets: names of the poses that can be loaded.
        commands: functions that the controls call.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        state: LabelState,
        presets: Sequence[str],
        commands: Commands,
    ) -> None:
        self._gui, self._state, self._do = server.gui, state, commands
        self._sliders: dict[int, viser.GuiSliderHandle[float]] = {}
        self._gesture: tuple[int, float, int] = (-1, 0.0, 0)  # joint, time, number
        gui = self._gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(18, 128, 122))
        gui.main_panel.dock_right()
        self._head = gui.add_html("")
        self._metrics = gui.add_html("")
        self._history()
        self._presets(presets)
        self._trial()
        self._saving()
        with gui.add_folder("View", expand_by_default=False):
            self._view()
        for group in sorted({j.group for j in state.joints}, key=_rank):
            with gui.add_folder(group, expand_by_default=group in _ORDER[:2]):
                for joint in (j for j in state.joints if j.group == group):
                    self._slider(joint)

    def say(self, text: str, color: str = "") -> None:
        """Show a message above the metrics, until the next one."""
        scene = self._state.scene
        title = f"<b>{html.escape(scene.task.id)}</b>, hand {html.escape(scene.hand.name)}"
        line = f'<div style="color:{color or "inherit"};min-height:1.4em">{html.escape(text)}</div>'
        self._head.content = _block(f"<div>{title}</div>{line}")

    def complain(self, text: str) -> None:
        """Show an error."""
        self.say(text, _RED)

    def show(self, metrics: Metrics, moved_by: int | None) -> None:
        """Show the pose and its metrics, without changing the slider of joint ``moved_by``."""
        qpos = self._state.qpos
        for joint in self._state.joints:
            slider = self._sliders[joint.index]
            shown = round(float(qpos[joint.index]) * joint.scale, 2)
            if joint.index != moved_by and slider.value != shown:
                slider.value = shown
        self._metrics.content = _block(_as_html(metrics, self._state))

    def offer_anyway(self, offered: bool) -> None:
        """Show or hide the button 'Save anyway'."""
        self._anyway.visible = offered

    def progress(self, share: float | None, text: str) -> None:
        """Show the trial's progress (0..1; None if no trial is running) and its description."""
        running = share is not None
        self._try.disabled, self._cancel.visible = running, running
        self._bar.visible = running
        if share is not None:
            self._bar.value = 100.0 * min(max(share, 0.0), 1.0)
        self._result.content = _block(text) if text else ""

    def _history(self) -> None:
        gui, do = self._gui, self._do
        actions = {"Undo": do.undo, "Redo": do.redo, "Start pose": do.reset}
        group = gui.add_button_group("History", tuple(actions), hint="Ctrl-Z, Ctrl-Shift-Z")
        group.on_click(_handler(lambda event: actions[event.target.value]()))
        undo = gui.add_command("Undo", hotkey="Z", modifier="cmd/ctrl")
        undo.on_trigger(_handler(lambda _: do.undo()))
        redo = gui.add_command("Redo", hotkey="Z", modifier="cmd/ctrl+shift")
        redo.on_trigger(_handler(lambda _: do.redo()))

    def _presets(self, presets: Sequence[str]) -> None:
        group = self._gui.add_button_group("Pose from", tuple(presets))
        group.on_click(_handler(lambda event: self._do.preset(event.target.value)))

    def _trial(self) -> None:
        gui = self._gui
        self._try = gui.add_button(
            "Try it", icon=viser.Icon.PLAYER_PLAY, hint="Plan the reach, then grasp and lift"
        )
        self._cancel = gui.add_button("Cancel", icon=viser.Icon.PLAYER_STOP, visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._result = gui.add_html("")
        self._try.on_click(_handler(lambda _: self._do.try_it()))
        self._cancel.on_click(_handler(lambda _: self._do.cancel()))

    def _saving(self) -> None:
        gui = self._gui
        save = gui.add_button("Save", icon=viser.Icon.DEVICE_FLOPPY, color="teal")
        self._anyway = gui.add_button("Save anyway", color="red", visible=False)
        save.on_click(_handler(lambda _: self._do.save(False)))
        self._anyway.on_click(_handler(lambda _: self._do.save(True)))

    def _view(self) -> None:
        handles = self._gui.add_button_group("Handles", HANDLES)
        solid = self._gui.add_checkbox(
            "Contact shapes", False, hint="Geometry that contacts are computed with"
        )
        handles.on_click(_handler(lambda event: self._do.handles(event.target.value)))
        solid.on_update(_handler(lambda event: self._do.solid(event.target.value)))

    def _slider(self, joint: Joint) -> None:
        kinematics = self._state.kinematics
        # Rounded inwards, so that no value exceeds the limits.
        low = float(np.ceil(kinematics.low[joint.index] * joint.scale * 100) / 100)
        high = float(np.floor(kinematics.high[joint.index] * joint.scale * 100) / 100)
        value = round(float(self._state.qpos[joint.index]) * joint.scale, 2)
        slider = self._gui.add_slider(
            f"{joint.label} [{joint.unit}]",
            min=low,
            max=high,
            step=_STEP,
            initial_value=min(max(value, low), high),
            hint=f"joint {joint.name}",
        )
        self._sliders[joint.index] = slider

        async def moved(event: viser.GuiEvent) -> None:
            if event.client_id is not None:  # moved by a person, not by `show`
                value = float(event.target.value) / joint.scale
                self._do.set_joint(joint.index, value, self._gesture_of(joint.index))

        slider.on_update(moved)

    def _gesture_of(self, joint: int) -> object:
        """Return an id of a slider's movement: a new one after a pause or on another slider."""
        before, when, number = self._gesture
        now = time.monotonic()
        number += before != joint or now - when > PAUSE_S
        self._gesture = joint, now, number
        return "slider", joint, number


def _rank(group: str) -> tuple[int, str]:
    return (_ORDER.index(group) if group in _ORDER else len(_ORDER), group)


def _handler(action: Callable[[Any], None]) -> Callable[[Any], Coroutine[Any, Any, None]]:
    """Return a viser callback: a coroutine, since viser runs coroutines in the order of events."""

    async def handle(event: Any) -> None:
        action(event)

    return handle


def _block(text: str) -> str:
    return f'<div style="font-size:0.85em;line-height:1.45;padding:0 0.6em 0.2em">{text}</div>'


def _dot(color: str, text: str) -> str:
    dot = f'<span style="color:{color}">&#9679;</span>'
    return f"<div>{dot} {html.escape(text)}</div>"


def _as_html(metrics: Metrics, state: LabelState) -> str:
    if metrics.free:
        lines = [_dot(GREEN, "touches nothing")]
    else:
        lines = [
            _dot(_RED, f"{t.part} is {1e3 * t.depth_m:.1f} mm inside {t.body}")
            for t in metrics.touches[:4]
        ]
        more = len(metrics.touches) - 4
        lines += [_dot(_RED, f"and {more} more")] if more > 0 else []
    if metrics.beyond:
        lines.append(_dot(_AMBER, f"outside the actuators' range: {', '.join(metrics.beyond)}"))
    else:
        lines.append(_dot(GREEN, "within the actuators' range ('Try it' checks the reach)"))
    cells = sorted(
        zip((f.name for f in state.kinematics.fingers), metrics.tip_distances_m, strict=True),
        key=lambda cell: _rank(cell[0].capitalize()),
    )
    names = "".join(f'<td style="padding-right:0.9em">{html.escape(n)}</td>' for n, _ in cells)
    values = "".join(f"<td>{_millimetres(float(d))}</td>" for _, d in cells)
    lines.append(
        '<div style="opacity:0.75;padding-top:0.2em">fingertips to the object [mm]</div>'
        f"<table><tr>{names}</tr><tr>{values}</tr></table>"
    )
    return "".join(lines)


def _millimetres(distance: float) -> str:
    if distance >= FAR_M:
        return "far"
    text = f"{1e3 * distance:.1f}"
    return f'<span style="color:{_RED}">{text}</span>' if distance < 0 else text
