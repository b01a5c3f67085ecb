"""Serves a simulated Franka arm on the loopback interface until its input is closed."""

import sys

from franky_sim import SimulationServer
from franky_sim.mujoco_simulator import MujocoSimulator

with MujocoSimulator(enable_visualization=False) as simulator:
    robot = simulator.add_robot()
    with SimulationServer(simulator) as server:
        server.run_async()
        sys.stdout.write(f"{robot.hostname}\n")
        sys.stdout.flush()
        sys.stdin.read()
