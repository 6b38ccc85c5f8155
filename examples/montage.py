"""Films of the gallery side by side as one small GIF: python examples/montage.py renders/gallery."""

import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg

FILMS = ("acrobot", "high-dive", "puma")  # at the speed that each of them names
SECONDS, FPS, WIDTH = 7, 10, 400

folder = Path(sys.argv[1])
inputs, panels = [], []
for k, name in enumerate(FILMS):
    inputs += ["-i", str(folder / f"{name}.mp4")]
    # A film that ends early stays on its last picture.
    size = f"scale={WIDTH}:-2:flags=area"
    panels.append(f"[{k}]fps={FPS},{size},tpad=stop_mode=clone:stop_duration=6[p{k}]")
beside = "".join(f"[p{k}]" for k in range(len(FILMS))) + f"hstack=inputs={len(FILMS)},trim=duration={SECONDS}"
colours = "split[x][y];[x]palettegen=max_colors=96[c];[y][c]paletteuse=dither=none"
command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y", *inputs]
command += ["-filter_complex", ";".join([*panels, f"{beside},{colours}"]), str(folder / "planner.gif")]
subprocess.run(command, check=True)
