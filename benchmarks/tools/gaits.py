"""The moving picture of the README: `python benchmarks/tools/gaits.py RUN_DIR... --out docs/gaits.gif`.

One real episode of each run's policy, side by side, at the speed of the simulation. Needs OpenGL (see `metrpo doctor`).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from metrpo import load_policy
from metrpo.run.task_file import task_of_run

SECONDS, FPS, SIDE = 4, 20, 200


def frames_of(run_dir: Path, seed: int) -> list[Image.Image]:
    """Pictures of an episode's first seconds, as many a second as `FPS` says, with the task's name."""
    policy = load_policy(run_dir)
    env = task_of_run(run_dir, policy.info).make_env(render_mode="rgb_array")
    state, _ = env.reset(seed=seed)
    shown, over = [], False
    per_second = env.metadata["render_fps"]
    for step in range(round(SECONDS * per_second)):
        if not over:
            state, _, terminated, truncated, _ = env.step(policy(state))
            over = terminated or truncated
        if int(step * FPS / per_second) == len(shown):
            shown.append(_labelled(env.render(), policy.info.task))
    env.close()
    return shown


def _labelled(frame: np.ndarray, name: str) -> Image.Image:
    picture = Image.fromarray(frame).resize((SIDE, SIDE))
    draw = ImageDraw.Draw(picture)
    draw.rectangle((4, 4, 14 + draw.textlength(name), 20), fill="black")
    draw.text((9, 6), name, fill="white")
    return picture


def main() -> None:
    """Writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dirs", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=Path("docs/gaits.gif"))
    parser.add_argument("--seed", type=int, default=0, help="decides the start states")
    given = parser.parse_args()
    columns = [frames_of(run_dir, given.seed) for run_dir in given.run_dirs]
    pictures = []
    for row in zip(*columns, strict=False):
        picture = Image.new("RGB", (SIDE * len(row), SIDE))
        for i, frame in enumerate(row):
            picture.paste(frame, (SIDE * i, 0))
        pictures.append(picture.quantize(24))
    pictures[0].save(given.out, save_all=True, append_images=pictures[1:], duration=1000 // FPS, loop=0, optimize=True)
    print(given.out)


if __name__ == "__main__":
    main()
