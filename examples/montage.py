"""Six films side by side as one small GIF: python examples/montage.py renders renders/gallery/planner.gif.

Draws the plans that `planner run` left in renders/NAME. All begin and end together, so a panel says how fast it plays.
"""

import json
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import planner
from planner.proof.replays.replaying import Replay, replay
from planner.view.render.film import Film
from planner.view.render.scene import Scene

ROWS = (
    {"hopper": "Hops 20 inches", "quadruped": "Rises from a crouch", "quadrotor": "Flies through a window"},
    {"around-a-post": "Reaches around a post", "human-step": "Walks passive legs", "acrobot": "Swings up by its elbow"},
)
WIDTH, HEIGHT, BAND, GAP, LETTERS = 320, 236, 28, 4, 14  # pixels
PLAYED, HELD, FPS = 4.8, 1.2, 10  # s of motion, s that the last pictures stay, pictures per s
INK, QUIET, GOOD = (28, 32, 40), (92, 99, 112), (20, 113, 58)


def drawn(shown: Replay) -> list[np.ndarray]:
    """Pictures (HEIGHT, WIDTH, 3) of a replay at equal times, without words."""
    film = Film.of(shown, np.linspace(shown.t[0], shown.t[-1], round(PLAYED * FPS) + 1)).views[0]
    with Scene(film, WIDTH, HEIGHT, words=False) as scene:
        return [scene.draw(frame).copy() for frame in range(len(film))]


def captioned(picture: np.ndarray, words: str, speed: float, verdict: str) -> Image.Image:
    """A picture with a line of words under it."""
    panel = Image.new("RGB", (WIDTH, HEIGHT + BAND), "white")
    panel.paste(Image.fromarray(picture), (0, 0))
    fonts = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    font, bold = (ImageFont.truetype(str(fonts / f"DejaVuSans{kind}.ttf"), LETTERS) for kind in ("", "-Bold"))
    pen, line = ImageDraw.Draw(panel), HEIGHT + BAND // 2
    pen.text((6, line), words, INK, font, anchor="lm")
    right = WIDTH - 6 - bold.getlength(f" {verdict}")
    pen.text((right, line), f"{speed:.1g}\N{MULTIPLICATION SIGN}", QUIET, font, anchor="rm")
    pen.text((WIDTH - 6, line), verdict, GOOD if verdict == "PASS" else INK, bold, anchor="rm")
    return panel


def panels(folder: Path, words: str) -> list[Image.Image]:
    """The pictures of a run."""
    shown = replay(planner.load_plan(folder / "plan.npz"))
    verdict = json.loads((folder / "proof.json").read_text(encoding="utf-8"))["verdict"]
    speed = float(shown.t[-1] - shown.t[0]) / PLAYED
    return [captioned(picture, words, speed, verdict) for picture in drawn(shown)]


def main(runs: Path, path: Path) -> None:
    """Draw the plans of runs/NAME/plan.npz into one GIF."""
    rows = [[panels(runs / name, words) for name, words in row.items()] for row in ROWS]
    size = 3 * WIDTH + 2 * GAP, 2 * (HEIGHT + BAND) + GAP
    frames = []
    for frame in range(len(rows[0][0])):
        sheet = Image.new("RGB", size, "white")
        for r, row in enumerate(rows):
            for c, pictures in enumerate(row):
                sheet.paste(pictures[frame], (c * (WIDTH + GAP), r * (HEIGHT + BAND + GAP)))
        frames.append(sheet.tobytes())
    frames += frames[-1:] * round(HELD * FPS)
    colours = "split[x][y];[x]palettegen=max_colors=112[c];[y][c]paletteuse=dither=none:diff_mode=rectangle"
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"]
    command += ["-s", f"{size[0]}x{size[1]}", "-r", str(FPS), "-i", "-", "-filter_complex", colours, str(path)]
    subprocess.run(command, input=b"".join(frames), check=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
