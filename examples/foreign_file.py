"""A file of another program becomes a run, is filtered and exported: `python examples/foreign_file.py FILE FOLDER`.

FILE is a table with the columns of `COLUMNS`; change these to those of your file.
"""

import sys
from pathlib import Path

import dragrig

COLUMNS = {"time": "t [s]", "force": "F [N]", "position": "x [mm]"}

file, folder = map(Path, sys.argv[1:3])
folder.mkdir(parents=True, exist_ok=True)
imported = dragrig.import_run(file, folder, columns=COLUMNS)
run = dragrig.filter(imported.path, window_s=0.1)
[exported] = dragrig.export(imported.path, folder / "filtered.csv")
print(run, *(event.message for event in imported.events), f"exported to {exported}", sep="\n")
