"""The controls of the viewer: what a key does to the time shown and to what is shown. Knows no window."""

from __future__ import annotations

from dataclasses import dataclass

SPACE, RIGHT, LEFT, DOWN, UP, HOME, END = 32, 262, 263, 264, 265, 268, 269  # GLFW's numbers of keys
KEYS = (
    ("space", "pause or go on"), ("left, right", "back or on by a hundredth; pauses"), ("home, end", "start or end"),
    ("up, down", "faster or slower"), ("6", "ghost of the plan on or off"), ("7", "perturbed simulations on or off"),
    ("8", "open loop or with gains"),
)  # fmt: skip
"""Keys and what they do; digits from 6 on have no meaning of their own in MuJoCo's viewer."""

_STEP = 0.01  # of the whole motion: one press of an arrow
_FASTER = 2.0 ** (1 / 2)
_SLOWEST, _FASTEST = 1 / 64, 8.0
_REST = 1.0  # s that the end stays before the motion begins again


@dataclass
class Player:
    """What the viewer shows now."""

    end: float  # s, of the motion, which begins at 0
    speed: float  # of playback
    t: float = 0.0  # s, of the motion
    playing: bool = True
    ghost: bool = True
    rollouts: bool = False
    gains: bool = True  # the replay with gains, in place of the one without
    rested: float = 0.0  # s that the end has been shown

    def press(self, key: int) -> None:
        """Obey a key, by GLFW's number; other keys are MuJoCo's own."""
        step = _STEP * self.end
        if key == SPACE:
            self.playing = not self.playing
        elif key in (LEFT, RIGHT, HOME, END):
            places = {LEFT: self.t - step, RIGHT: self.t + step, HOME: 0.0, END: self.end}
            self.t, self.playing = min(max(places[key], 0.0), self.end), False
        elif key in (UP, DOWN):
            speed = self.speed * (_FASTER if key == UP else 1.0 / _FASTER)
            self.speed = min(max(speed, _SLOWEST), _FASTEST)
        elif key == ord("6"):
            self.ghost = not self.ghost
        elif key == ord("7"):
            self.rollouts = not self.rollouts
        elif key == ord("8"):
            self.gains = not self.gains
        self.rested = 0.0

    def advance(self, seconds: float) -> None:
        """Let so much time of the watcher pass, s. The motion begins again a second after its end."""
        if not self.playing:
            return
        left = (self.end - self.t) / self.speed
        self.t = min(self.t + seconds * self.speed, self.end)
        self.rested += max(0.0, seconds - left)
        if self.rested > _REST:
            self.t, self.rested = 0.0, 0.0

    def words(self) -> tuple[str, str]:
        """The state of the player, as two columns of lines."""
        rows = {
            "time": f"{self.t:.3f} of {self.end:.3f} s" + ("" if self.playing else ", paused"),
            "speed": f"{self.speed:.3g}", "replay (8)": "with gains" if self.gains else "open loop",
            "ghost (6)": "on" if self.ghost else "off", "rollouts (7)": "on" if self.rollouts else "off",
        }  # fmt: skip
        return "\n".join(rows), "\n".join(rows.values())
