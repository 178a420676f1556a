"""Simulate, calibrate, correct and benchmark AMCW time-of-flight cameras.

The names below are the light core (numpy only); everything heavier is imported by the module
that needs it, when it is needed.
"""

from toftools.phasor import demodulate as demodulate
from toftools.types import Camera as Camera
from toftools.types import Capture as Capture
from toftools.types import DepthMap as DepthMap
from toftools.types import Modulation as Modulation
from toftools.types import Noise as Noise
from toftools.types import Phasors as Phasors
from toftools.types import Scene as Scene
from toftools.types import Sensor as Sensor
from toftools.types import Shot as Shot
from toftools.types import Taps as Taps
from toftools.types import Truth as Truth

__version__ = "0.1.0"
