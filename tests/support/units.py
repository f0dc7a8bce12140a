"""A pan-tilt unit of another series than the D46, with the replies and habits of its firmware."""

from cotarget.emulators.ptu_d46.unit import UnitProfile, Wording

# An E-series unit: eight steps to one of a D46.
E_SERIES = UnitProfile(
    version=(3, 2, 1),
    title="Pan-Tilt Controller v3.2.1(E46), (C)2011 FLIR Commercial Systems, Inc., All Rights Reserved",
    step=23.142857, resolution_digits=6, pan=(-24720, 24720), tilt=(-7256, 4832), stop_margin=240, slip=64,
    speed=8000, base_speed=456, lowest_speed=0, highest_speed=23216, ceiling=48000, acceleration=16000,
    reset_speed=8000, tables_s=0.5, leading_lf=True, reset_at_once=True, halt_waits=True,
    greeting="\r\n### PAN-TILT CONTROLLER v3.2.1 ###\r\n*\r\n",
    wording=Wording(
        offset="Target {axis} position is {n}", speed="Desired {axis} speed is {n} positions/sec",
        illegal="Illegal Command Entered", out_of_range="Illegal Command Entered", uncalibrated="Axis Error",
        independent=("PTU is in Independent Mode", "Independent speed control mode"),
        velocity=("PTU is in Pure Velocity Mode", "Pure Velocity speed control mode"), regular="REG",
    ),
)  # fmt: skip
