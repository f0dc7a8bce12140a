// Drives a pan-tilt unit by MRPT's CPtuDPerception: what it reads and does is printed as lines "result NAME NUMBERS".
#include <mrpt/hwdrivers/CPtuDPerception.h>

#include <chrono>
#include <cmath>
#include <cstdio>
#include <thread>

using Unit = mrpt::hwdrivers::CPtuDPerception;
using Clock = std::chrono::steady_clock;

constexpr double STEPS = 1.5;  // an axis is there when it is nearer than this: MRPT truncates angles to steps
constexpr auto DEADLINE = std::chrono::seconds(20);

double where(Unit& unit, char axis)
{
	double angle = NAN;
	return unit.absPosQ(axis, angle) ? angle : NAN;
}

bool arrives(Unit& unit, char axis, double goal)
{
	const auto start = Clock::now();
	while (std::abs(where(unit, axis) - goal) > STEPS * unit.panResolution)
		if (Clock::now() - start > DEADLINE) return false;
	return unit.aWait();
}

bool stands(Unit& unit, char axis)
{
	const auto start = Clock::now();
	for (double before = NAN; Clock::now() - start < DEADLINE;)
	{
		const double now = where(unit, axis);
		if (now == before) return true;
		before = now;
		std::this_thread::sleep_for(std::chrono::milliseconds(50));
	}
	return false;
}

int fail(Unit& unit, const char* what)
{
	std::printf("failed %s, error %d\n", what, unit.checkErrors());
	return 1;
}

int main(int, char** arguments)
{
	Unit unit;
	unit.clearErrors();
	if (!unit.init(arguments[1])) return fail(unit, "init");
	std::printf("result resolution %.12f %.12f\n", unit.panResolution, unit.tiltResolution);

	double lowest = NAN, highest = NAN, speed = NAN;
	if (!unit.minPosQ(Unit::Pan, lowest) || !unit.maxPosQ(Unit::Pan, highest)) return fail(unit, "limits");
	std::printf("result pan_limits %.12f %.12f\n", lowest, highest);

	if (!unit.moveToAbsPos(Unit::Pan, 0.3) || !unit.moveToAbsPos(Unit::Tilt, -0.2)) return fail(unit, "move");
	if (!arrives(unit, Unit::Pan, 0.3) || !arrives(unit, Unit::Tilt, -0.2)) return fail(unit, "arrival");
	std::printf("result moved %.12f %.12f\n", where(unit, Unit::Pan), where(unit, Unit::Tilt));

	if (!unit.moveToOffPos(Unit::Pan, -0.1) || !unit.aWait()) return fail(unit, "offset");
	std::printf("result offset %.12f\n", where(unit, Unit::Pan));

	const bool refused = !unit.moveToAbsPos(Unit::Pan, 3.0);
	std::printf("result refused %d %d\n", refused, unit.checkErrors());
	unit.clearErrors();

	if (!unit.speed(Unit::Pan, 0.1) || !unit.speedQ(Unit::Pan, speed)) return fail(unit, "speed");
	std::printf("result speed %.12f\n", speed);
	if (!unit.moveToAbsPos(Unit::Pan, -0.5)) return fail(unit, "slow move");
	std::this_thread::sleep_for(std::chrono::milliseconds(300));
	if (!unit.haltAll() || !stands(unit, Unit::Pan)) return fail(unit, "halt");
	std::printf("result halted %.12f\n", where(unit, Unit::Pan));
	std::fflush(stdout);
	std::getchar();  // the halted head is looked at

	unit.clearErrors();
	std::printf("result reset %d\n", unit.reset());
	std::printf("result home %.12f %.12f\n", where(unit, Unit::Pan), where(unit, Unit::Tilt));
	return 0;
}
