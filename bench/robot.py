"""How long 1000 periods of a capsule robot take, on the hard surface and in the gut.

    python bench/robot.py [PERIODS]

CPU time, one thread of linear algebra, from rest. Once a period ends in the state in which it began, the further ones
are copied; beside it, what it takes to simulate all of them, and how far the two end apart.
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
    "slips back in the gut": RobotDrive(slow_mm_s2=16000, fast_mm_s2=15000, stroke_mm=10),
}


def main() -> None:
    """Print a line for each surface and drive."""
    periods = int(sys.argv[1]) if sys.argv[1:] else 1000
    robot = find_settings(RobotSettings, "robot", "capsubot")
    surfaces = {"hard": partial(hard_ground, robot), "gut": partial(gut, robot, FrictionModelSettings(), 2.5)}
    for name, surface in surfaces.items():
        for drive_name, drive in DRIVES.items():
            walk(robot, drive, surface(), 3)
            walks, taken = [], []
            for may_copy in (True, False):
                begin = time.process_time()
                walks.append(walk(robot, drive, surface(), periods, may_copy=may_copy))
                taken.append(time.process_time() - begin)
            copied, simulated = walks
            apart = abs(copied.position_mm - simulated.position_mm) / abs(simulated.position_mm)
            print(
                f"{name:5} {drive_name:27} {periods} periods in {taken[0]:5.2f} s, of which the first "
                f"{copied.settled_periods or periods} simulated; all simulated {taken[1]:5.2f} s, travel apart "
                f"{apart:.0e}, energy balance {energy_error(simulated.periods):.0e}"
            )


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
