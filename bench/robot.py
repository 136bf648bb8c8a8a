"""How long 1000 periods of a capsule robot take, on the hard surface and in the gut.

    python bench/robot.py [PERIODS]

User CPU time, one thread of linear algebra; the first periods count, in which the wall becomes the walk's own.
"""

import sys
import time
from functools import partial

from threadpoolctl import threadpool_limits

from dragrig.config import FrictionModelSettings, RobotDrive, RobotSettings, find_settings
from dragrig.sim_backend.robot import energy_error, gut, hard_ground, walk

DRIVES = {
    "sticks on the hard surface": RobotDrive(slow_mm_s2=1400, fast_mm_s2=16000, stroke_mm=10.9),
    "chosen for the gut": RobotDrive(slow_mm_s2=14000, fast_mm_s2=16000, stroke_mm=10.4),
}


def main() -> None:
    """Print a line for each surface and drive."""
    periods = int(sys.argv[1]) if sys.argv[1:] else 1000
    robot = find_settings(RobotSettings, "robot", "capsubot")
    surfaces = {"hard": partial(hard_ground, robot), "gut": partial(gut, robot, FrictionModelSettings(), 2.5)}
    for name, surface in surfaces.items():
        for drive_name, drive in DRIVES.items():
            walk(robot, drive, surface(), 3)
            begin = time.process_time()
            made = walk(robot, drive, surface(), periods)
            taken = time.process_time() - begin
            print(
                f"{name:5} {drive_name:28} {periods} periods in {taken:6.2f} s, "
                f"energy balance {energy_error(made.periods):.0e}"
            )


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
