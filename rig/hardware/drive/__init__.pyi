from .link import DriveLink as DriveLink
from .monitor import StageDevices as StageDevices
from .monitor import Watchdog as Watchdog
from .position_mode import PositionModeStage as PositionModeStage
from .stage_base import MonitoredStage as MonitoredStage
from .stage_base import write_safeguards as write_safeguards
from .stage_base import write_travel as write_travel
from .velocity_stage import VelocityModeStage as VelocityModeStage
