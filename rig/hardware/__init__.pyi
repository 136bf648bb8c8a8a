from .backend import HardwareBackend as HardwareBackend
from .lines import CardLines as CardLines
from .sync import FirstSample as FirstSample
from .sync import MotionSamplingSync as MotionSamplingSync
