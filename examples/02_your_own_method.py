"""A method of your own on one capture; in the whole benchmark it takes the commands of its file.

Run: python examples/02_your_own_method.py
"""

from your_method import make

from toftools import Scene, Shot
from toftools.registry import METRICS
from toftools.sensors import sensor
from toftools.sim.analytic import analytic

device = sensor("opt8241:width=64,height=48")
capture = analytic(Scene("wall", {"range": 2.0}))(Shot(device, seed=3))
answer = make(device)(capture.phasors)
for name in ("mae_m", "valid_share"):
    print(f"{name}: {METRICS[name].build(capture.truth)(answer):.4f}")
assert METRICS["mae_m"].build(capture.truth)(answer) < 0.01  # noise alone: 6 mm at 70 MHz
assert METRICS["valid_share"].build(capture.truth)(answer) > 0.99
