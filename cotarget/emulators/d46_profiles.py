"""The units that the D46 emulator can be: limits, resolution, speeds, and how each firmware words its replies.

Sources: S1 = PTU-D46 manual v2.14.0 (2006), S2 = Command Reference Manual v3.00D (2008), S3 = PTU-E46 manual; and what
published drivers read from real units. Where these disagree, the profiles do.
"""

import math
from dataclasses import dataclass

from cotarget.errors import ConfigError

# Arc seconds a degree.
ARCSEC = 3600.0
# Share of a step within which limits given in degrees count as reached [steps]: a rig's step is given to some digits.
STEP_SLACK = 0.02
# Position counts beyond this are no pan-tilt unit's: the finest E-series step over a whole turn is a tenth of it.
MOST_COUNTS = 1_000_000

Range = tuple[int, int]


@dataclass(frozen=True)
class Wording:
    """What the sources word differently; ``{axis}`` becomes Pan or Tilt, ``{n}`` a number.

    Attributes:
        offset: reply to the query of an axis' desired position.
        speed: of its desired speed.
        acceleration: of its acceleration.
        resolution: of its resolution.
        too_fast: refusal of a speed above the upper bound.
        illegal: refusal of what is not understood.
        out_of_range: refusal of any other number.
        uncalibrated: refusal of a move before the reset; None if the limits of 0 refuse it.
        independent: reply to the query of the control mode, verbose and terse.
        velocity: the same in pure velocity mode.
        regular: terse word for regular power.
    """

    offset: str = "Current {axis} position is {n}"
    speed: str = "Target {axis} speed is {n} positions/sec"
    acceleration: str = "{axis} acceleration is {n} positions/sec^2"
    resolution: str = "{n} seconds arc per position"
    too_fast: str = "{axis} speed cannot exceed {n} positions/sec"
    illegal: str = "Illegal argument"
    out_of_range: str = "Illegal argument"
    uncalibrated: str | None = None
    independent: tuple[str, str] = ("independent control mode", "independent control mode")
    velocity: tuple[str, str] = ("pure velocity control mode", "pure velocity control mode")
    regular: str = "REGULAR"


@dataclass(frozen=True)
class UnitProfile:
    """One model of pan-tilt unit, as its firmware announces itself.

    Attributes:
        name: of the profile.
        version: of the firmware; commands that came later are unknown to it.
        title: reply to the query of the version.
        step: resolution of both axes [arc seconds].
        resolution_digits: decimals of it in replies.
        pan: lowest and highest position that the reset finds [steps].
        tilt: the same of tilt.
        stop_margin: from those to the mechanical stops [steps].
        slip: steps lost when an axis runs into something.
        speed: desired speed at power-up [steps/s].
        base_speed: up to it a speed is there at once [steps/s].
        lowest_speed: lower bound at power-up [steps/s].
        highest_speed: upper bound at power-up [steps/s].
        ceiling: highest upper bound that can be set [steps/s].
        acceleration: at power-up [steps/s^2].
        reset_speed: at which the stops are sought [steps/s].
        tables_s: time to compute the tables after a change of acceleration or a bound [s].
        boot_s: from power to being ready, without a reset [s].
        leading_lf: whether a command ended by CR is answered after a line feed.
        reset_at_once: whether RE, RP and RT reset now, rather than say what R and power-up do.
        halt_waits: whether H answers once the axes stand, rather than at once; the sources do not say.
        expansion: whether the unit has the ports A and B.
        slip_ring: whether it can turn without end.
        greeting: what a TCP client is told when it connects; empty for a plain serial line.
        wording: of the replies.
    """

    name: str
    version: tuple[int, int, int]
    title: str
    step: float
    pan: Range
    tilt: Range
    resolution_digits: int = 4
    stop_margin: int = 30
    slip: int = 8
    speed: int = 1000
    base_speed: int = 1000
    lowest_speed: int = 31
    highest_speed: int = 2902
    ceiling: int = 6000
    acceleration: int = 2000
    reset_speed: int = 1000
    tables_s: float = 3.0
    boot_s: float = 1.0
    leading_lf: bool = False
    reset_at_once: bool = False
    halt_waits: bool = False
    expansion: bool = False
    slip_ring: bool = False
    greeting: str = ""
    wording: Wording = Wording()

    @property
    def banner(self) -> str:
        """What it prints when it gets power, but for the star of readiness."""
        return f"\r\n{self.title}\r\n"

    @classmethod
    def from_degrees(
        cls,
        pan: tuple[float, float],
        tilt: tuple[float, float],
        step: float,
        speed: float,
        acceleration: float,
        name: str = "d46_sim",
    ) -> "UnitProfile":
        """Announce a head that is known in degrees, such as a simulated rig's.

        Its ramps start from rest (base speed 0), as the simulated head's do, and its stops are its limits, so that not
        even a reset leaves them.

        Args:
            pan: lowest and highest [degrees].
            tilt: lowest and highest [degrees].
            step: resolution of both axes [degrees].
            speed: highest, and that of moves at power-up [degrees/s].
            acceleration: of both axes [degrees/s^2].
            name: of the profile.

        Raises:
            ConfigError: the head does not move in steps, or its range in steps is no such unit's.
        """
        if not step > 0 or max(abs(angle) for angle in (*pan, *tilt)) / step > MOST_COUNTS:
            raise ConfigError(f"head.step: {step:g} degrees is no step of a PTU-D46; 0.0514286 is its usual one")

        def counts(limits: tuple[float, float]) -> Range:
            return math.ceil(limits[0] / step - STEP_SLACK), math.floor(limits[1] / step + STEP_SLACK)

        fastest = max(round(speed / step), 1)
        return cls(
            name=name,
            version=(2, 14, 0),
            title="Pan-Tilt Controller v2.14.0(C14/E), (C)2006 Directed Perception, Inc., All Rights Reserved",
            step=step * ARCSEC,
            resolution_digits=6,
            pan=counts(pan),
            tilt=counts(tilt),
            stop_margin=0,
            speed=fastest,
            base_speed=0,
            lowest_speed=min(31, fastest),
            highest_speed=fastest,
            ceiling=fastest,
            acceleration=max(round(acceleration / step), 1),
            reset_speed=fastest,
        )


# A PTU-D46-17.5 as it leaves the factory: half steps, limits of the examples in S1 and S2.
D46_STOCK = UnitProfile(
    name="d46_stock",
    version=(2, 14, 0),
    title="Pan-Tilt Controller v2.14.0(C14/E), (C)2006 Directed Perception, Inc., All Rights Reserved",
    step=185.1428,
    pan=(-3090, 3090),
    tilt=(-907, 604),
)
# The paper's range, +-180 and -80..+30 degrees, which needs the extended-range option; an older firmware, with the
# wordings of S2 where S1 has others, of units that CARMEN and ASR met, and MRPT's prefix of numbers out of range.
D46_PAPER = UnitProfile(
    name="d46_paper",
    version=(2, 12, 1),
    title="Pan-Tilt Controller v2.12.1d1(C14/E), (C)2003 Directed Perception, Inc., All Rights Reserved",
    step=185.1428,
    pan=(-3500, 3500),
    tilt=(-1555, 583),
    base_speed=57,
    highest_speed=1985,
    wording=Wording(
        offset="Target {axis} position is {n}",
        acceleration="{axis} acceleration is {n} positions/sec/sec",  # ASR's parser allows no digit after the number
        resolution="{n} seconds arc per {axis} position",
        too_fast="{axis} speed cannot exceed {n} pos/sec",
        out_of_range="Value out of range",
        independent=("PTU is in independent control mode", "independent"),
        velocity=("PTU is in pure velocity control mode", "pure velocity"),
    ),
)
# An E-series unit: eight steps where a D46 has one.
E_SERIES = UnitProfile(
    name="e_series",
    version=(3, 2, 1),
    title="Pan-Tilt Controller v3.2.1(E46), (C)2011 FLIR Commercial Systems, Inc., All Rights Reserved",
    step=23.142857,
    resolution_digits=6,
    pan=(-24720, 24720),
    tilt=(-7256, 4832),
    stop_margin=240,
    slip=64,
    speed=8000,
    base_speed=456,
    lowest_speed=0,
    highest_speed=23216,
    ceiling=48000,
    acceleration=16000,
    reset_speed=8000,
    tables_s=0.5,
    leading_lf=True,
    reset_at_once=True,
    halt_waits=True,
    greeting="\r\n### PAN-TILT CONTROLLER v3.2.1 ###\r\n*\r\n",
    wording=Wording(
        offset="Target {axis} position is {n}",
        speed="Desired {axis} speed is {n} positions/sec",
        illegal="Illegal Command Entered",
        out_of_range="Illegal Command Entered",
        uncalibrated="Axis Error",
        independent=("PTU is in Independent Mode", "Independent speed control mode"),
        velocity=("PTU is in Pure Velocity Mode", "Pure Velocity speed control mode"),
        regular="REG",
    ),
)
PROFILES = {unit.name: unit for unit in (D46_STOCK, D46_PAPER, E_SERIES)}
