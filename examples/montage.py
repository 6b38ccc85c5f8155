"""Three films of the gallery side by side as one small GIF: python examples/montage.py renders/gallery."""

import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg

FILMS = {"acrobot": 1.4, "high-dive": 1.0, "puma": 1.25}  # and how many times faster each is shown
SECONDS, FPS, WIDTH = 5.2, 12, 300

folder = Path(sys.argv[1])
inputs, panels = [], []
for k, (name, faster) in enumerate(FILMS.items()):
    inputs += ["-i", str(folder / f"{name}.mp4")]
    # The left half of each film, open loop, without its captions; a film that ends early stays on its last picture.
    crop = f"crop=640:490:0:130,scale={WIDTH}:-2"
    panels.append(f"[{k}]setpts=PTS/{faster},fps={FPS},{crop},tpad=stop_mode=clone:stop_duration=6[p{k}]")
beside = "".join(f"[p{k}]" for k in range(len(FILMS))) + f"hstack=inputs={len(FILMS)},trim=duration={SECONDS}"
colours = "split[x][y];[x]palettegen=max_colors=96[c];[y][c]paletteuse=dither=none"
command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y", *inputs]
command += ["-filter_complex", ";".join([*panels, f"{beside},{colours}"]), str(folder / "planner.gif")]
subprocess.run(command, check=True)
