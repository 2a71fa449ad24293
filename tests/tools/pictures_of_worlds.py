"""python tests/tools/pictures_of_worlds.py FILE.png: draw five packaged worlds while hands move, for docs/worlds.md."""

import math
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

from PIL import Image

from haptic_loop.sim.scenario import load
from haptic_loop.sim.view.session import LiveLoop, Menu, first_loop
from haptic_loop.sim.view.stage import pictures_for

AT = {"cube": 1.5, "ball": 1.2, "peg": 2.0, "door": 1.5, "stack": 1.5}  # [s] when each scenario is drawn
SIZE = 300, 225


def main(file: str) -> None:
    whole = Image.new("RGB", (len(AT) * SIZE[0], SIZE[1]), "white")
    for i, (name, seconds) in enumerate(AT.items()):
        loop = first_loop(Menu("I"), load(f"world-{name}"), "moving-average")
        session = LiveLoop(loop, ThreadPoolExecutor(1), (), math.inf)
        with closing(pictures_for(session)) as artist:
            whole.paste(Image.fromarray(artist.rendered(session.frame(seconds), *SIZE)), (i * SIZE[0], 0))
    whole.quantize(128).save(file, optimize=True)


if __name__ == "__main__":
    main(sys.argv[1])
