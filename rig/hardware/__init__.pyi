from .backend import HardwareBackend as HardwareBackend
from .lines import DigitalLines as DigitalLines
from .sync import FirstSample as FirstSample
from .sync import MotionSamplingSync as MotionSamplingSync
