"""The robot at hand, for ``Roamer``: this is the file to fill in. As it stands it drives the example below.

Example: a round two-wheel robot on a board with MicroPython and Bluetooth (ESP32, Pico W), wired as

    left motor    bridge inputs on pins 2 (forward) and 3 (back); right motor on 4 and 5 (a DRV8833 or its like)
    encoders      one channel of each wheel on pins 6 (left) and 7 (right), one count per rising edge
    bumper        two switches to ground, pins 8 (left half) and 9 (right half), pressed = 0
    light         a phototransistor that looks at the projector, on analogue pin 26
    battery       through a divider by 2, on analogue pin 27

Whatever the robot, it must do what ``Hardware`` in ``robot.micropython.parts`` asks of it.
"""
# pyright: reportMissingImports=false, reportUnknownVariableType=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false, reportAttributeAccessIssue=false, reportMissingModuleSource=false
# MicroPython's own modules exist on the robot alone.

import math
import time

from machine import ADC, PWM, Pin

_CM_PER_COUNT = 0.055  # circumference of a wheel / counts a revolution: measure on the floor
_TRACK_CM = 9.5  # distance of the wheels
_FULL_DUTY = 65535
_TURN_DUTY = 0.35
_TURN_TIMEOUT_MS = 1500
_STRAIGHTEN = 0.02  # part of the duty by which a wheel that is one count ahead is slowed
_TURN = 2.0 * math.pi


class _Wheel:
    """A motor on two bridge inputs, and the encoder that counts its turns."""

    def __init__(self, forward_pin: int, back_pin: int, encoder_pin: int):
        self._forward = PWM(Pin(forward_pin), freq=20000, duty_u16=0)
        self._back = PWM(Pin(back_pin), freq=20000, duty_u16=0)
        self.counts = 0
        Pin(encoder_pin, Pin.IN, Pin.PULL_UP).irq(self._counted, Pin.IRQ_RISING)

    def _counted(self, _: object) -> None:
        self.counts += 1

    def push(self, share: float) -> None:
        """Drive at ``share`` of full duty, -1 (back) to 1 (forward); 0 brakes."""
        duty = int(_FULL_DUTY * min(1.0, abs(share)))
        self._forward.duty_u16(duty if share > 0 else 0)
        self._back.duty_u16(duty if share < 0 else 0)


class Robot:
    """The example robot."""

    top_speed_cm_s = 40.0

    def __init__(self):
        """Take the pins, motors off."""
        self._left = _Wheel(2, 3, 6)
        self._right = _Wheel(4, 5, 7)
        self._bumper_left = Pin(8, Pin.IN, Pin.PULL_UP)
        self._bumper_right = Pin(9, Pin.IN, Pin.PULL_UP)
        self._light = ADC(Pin(26))
        self._battery = ADC(Pin(27))
        self._heading_rad = 0.0
        self._share = 0.0
        self._pressed = False
        self._started_ms = time.ticks_ms()

    def clock_ms(self) -> int:
        """Since it was switched on; ``ticks_ms`` starts again from 0 after twelve days."""
        return time.ticks_diff(time.ticks_ms(), self._started_ms)

    def sleep_until(self, at_ms: int) -> None:
        """Wait."""
        time.sleep_ms(max(0, at_ms - self.clock_ms()))

    def drive(self, heading_rad: float, speed_cm_s: float) -> None:
        """Turn on the spot the short way, by the encoders, then roll."""
        left_rad = (heading_rad - self._heading_rad + math.pi) % _TURN - math.pi
        # On the spot each wheel rolls an arc of radius half the track.
        counts = abs(left_rad) * _TRACK_CM / 2.0 / _CM_PER_COUNT
        side = 1.0 if left_rad > 0 else -1.0
        self._reset()
        give_up_ms = self.clock_ms() + _TURN_TIMEOUT_MS
        while self._left.counts + self._right.counts < 2.0 * counts and self.clock_ms() < give_up_ms:
            self._left.push(side * _TURN_DUTY)
            self._right.push(-side * _TURN_DUTY)
            time.sleep_ms(1)
        self.stop()
        self._heading_rad = heading_rad
        self._reset()
        self._share = min(1.0, speed_cm_s / self.top_speed_cm_s)
        self.tend()

    def _reset(self) -> None:
        self._left.counts = 0
        self._right.counts = 0

    def tend(self) -> None:
        """Keep it straight: the wheel that is ahead gives way."""
        if self._share > 0.0:
            ahead = _STRAIGHTEN * (self._left.counts - self._right.counts)
            self._left.push(self._share * max(0.0, 1.0 - max(0.0, ahead)))
            self._right.push(self._share * max(0.0, 1.0 - max(0.0, -ahead)))

    def stop(self) -> None:
        """Brake."""
        self._share = 0.0
        self._left.push(0.0)
        self._right.push(0.0)

    def way_cm(self) -> float:
        """Mean of both wheels."""
        return 0.5 * (self._left.counts + self._right.counts) * _CM_PER_COUNT

    def light(self) -> float:
        """Mean of four readings, as the converter counts them: 0 to 65535."""
        return 0.25 * sum(self._light.read_u16() for _ in range(4))

    def bumped(self) -> float | None:
        """A press that begins: on one switch the wall is an eighth of a turn off the nose, on both ahead."""
        left, right = self._bumper_left.value() == 0, self._bumper_right.value() == 0
        began = (left or right) and not self._pressed
        self._pressed = left or right
        if not began:
            return None
        aside_rad = 0.0 if left and right else -math.pi / 4.0 if left else math.pi / 4.0
        return (self._heading_rad + aside_rad + math.pi) % _TURN

    def battery_mv(self) -> int:
        """At the divider by 2, against the 3.3 V reference."""
        return self._battery.read_u16() * 2 * 3300 // 65535
