"""Folders of rendered presses."""

import csv

from tiptrace.sim.presses import PressPlan, write_press_folder

MM_PER_PX = (0.0625, 0.0625)


def write(folder, layout=None, circles=True, columns=5, rows=3):
    presses = write_press_folder(folder, PressPlan(layout=layout, columns=columns, rows=rows, seed=3))
    if not circles:
        table = [(f["image"], f["ball_diameter_mm"]) for f in csv.DictReader((folder / "presses.csv").open())]
        with (folder / "presses.csv").open("w") as file:
            csv.writer(file).writerows([("image", "ball_diameter_mm"), *table])
    return presses
