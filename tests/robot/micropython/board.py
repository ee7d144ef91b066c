"""A simulated board for the example robot: ``machine``, ``bluetooth`` and ``time`` with a round robot behind them.

Runs under CPython and MicroPython alike. The robot rolls in a square arena and sees a lit square in its middle.
"""

import math

ARENA_CM = 80.0  # half of the way that its centre can go, each way from the middle
LIT_CM = 30.0
FULL_CM_S = 40.0
TRACK_CM = 9.5
CM_PER_COUNT = 0.055


class World:
    """Where the robot is and what its pins do; moved on by ``sleep_ms``."""

    def __init__(self):
        self.now_ms = 0
        self.until_ms = 0
        self.x_cm, self.y_cm, self.facing_rad = -20.0, 10.0, 0.3  # clockwise from the y axis
        self.duty = {}  # pin: duty
        self.encoders = {}  # pin: handler
        self.rolled = {6: 0.0, 7: 0.0}  # counts not yet told, by encoder
        self.touches = None  # heading from the robot to the wall, when it stands at one
        self.host = None

    def wheel(self, forward, back):
        return FULL_CM_S * (self.duty.get(forward, 0) - self.duty.get(back, 0)) / 65535.0

    def move(self, dt_s):
        left, right = self.wheel(2, 3), self.wheel(4, 5)
        for pin, speed in ((6, left), (7, right)):
            self.rolled[pin] += abs(speed) * dt_s / CM_PER_COUNT
            while self.rolled[pin] >= 1.0:
                self.rolled[pin] -= 1.0
                self.encoders[pin](None)
        turned = (left - right) / TRACK_CM * dt_s
        middle = self.facing_rad + 0.5 * turned
        self.facing_rad += turned
        way = 0.5 * (left + right) * dt_s
        x, y = self.x_cm + way * math.sin(middle), self.y_cm + way * math.cos(middle)
        self.x_cm, self.y_cm = max(-ARENA_CM, min(ARENA_CM, x)), max(-ARENA_CM, min(ARENA_CM, y))
        self.touches = None
        if x != self.x_cm:
            self.touches = math.pi / 2.0 if x > 0 else -math.pi / 2.0
        elif y != self.y_cm:
            self.touches = 0.0 if y > 0 else math.pi

    def pressed(self, side):
        """Whether the left (-1) or right (1) half of the bumper is: each reaches 0.25 rad beyond the middle."""
        if self.touches is None:
            return False
        aside = (self.touches - self.facing_rad + math.pi) % (2.0 * math.pi) - math.pi
        return -0.25 < side * aside < math.pi / 2.0


class Pin:
    IN, PULL_UP, IRQ_RISING = 0, 1, 1

    def __init__(self, number, mode=None, pull=None):
        self.number = number

    def irq(self, handler, trigger):
        world.encoders[self.number] = handler

    def value(self):
        return 0 if world.pressed(-1 if self.number == 8 else 1) else 1


class PWM:
    def __init__(self, pin, freq, duty_u16):
        self._pin = pin.number
        self.duty_u16(duty_u16)

    def duty_u16(self, duty):
        world.duty[self._pin] = duty


class ADC:
    def __init__(self, pin):
        self._pin = pin.number

    def read_u16(self):
        if self._pin == 27:
            return 38000
        return 42000 if max(abs(world.x_cm), abs(world.y_cm)) < LIT_CM else 6000


class Machine:
    Pin, PWM, ADC = Pin, PWM, ADC


class Time:
    def ticks_ms(self):
        return world.now_ms

    def ticks_diff(self, after, before):
        return after - before

    def sleep_ms(self, pause_ms):
        if world.now_ms >= world.until_ms:
            raise KeyboardInterrupt
        world.now_ms += pause_ms
        world.move(pause_ms / 1000.0)
        world.host(world.now_ms)


class Bluetooth:
    """The ``bluetooth`` module and its one radio."""

    FLAG_READ, FLAG_WRITE_NO_RESPONSE, FLAG_WRITE, FLAG_NOTIFY = 2, 4, 8, 16

    def __init__(self):
        self.services = ()
        self.values = {}
        self.advertised = []
        self.notified = []

    def BLE(self):
        return self

    def UUID(self, text):
        return text

    def active(self, on):
        pass

    def config(self, name=None, gap_name=None):
        return (0, b"\x00\x01\x02\x03\xbe\xef") if name == "mac" else None

    def irq(self, handler):
        self.interrupt = handler

    def gatts_register_services(self, services):
        self.services = services
        return (tuple(range(10, 10 + len(services[0][1]))),)

    def gatts_write(self, handle, value):
        self.values[handle] = value

    def gatts_read(self, handle):
        return self.values[handle]

    def gap_advertise(self, interval_us, adv_data):
        self.advertised.append(adv_data)

    def gatts_notify(self, host, handle, value):
        if host != 64:
            raise OSError(107)
        self.notified.append((handle, value))

    def handle(self, uuid):
        return 10 + [row[0] for row in self.services[0][1]].index(uuid)

    def write(self, uuid, value):
        handle = self.handle(uuid)
        self.values[handle] = value
        self.interrupt(3, (64, handle))


def plug_in(modules, minutes):
    """Put the simulated board where ``import`` looks; the world ends by a KeyboardInterrupt after ``minutes``."""
    world.__init__()
    world.until_ms = int(60000 * minutes)
    radio = Bluetooth()
    modules["machine"], modules["time"], modules["bluetooth"] = Machine(), Time(), radio
    return radio


def scenario(radio, start, stop, control, stop_ms):
    """A host that connects after 0.5 s, starts after 1 s, stops at ``stop_ms``, and goes."""
    todo = [
        (500, lambda: radio.interrupt(1, (64, 0, b""))),
        (1000, lambda: radio.write(control, start)),
        (stop_ms, lambda: radio.write(control, stop)),
        (stop_ms + 500, lambda: radio.interrupt(2, (64, 0, b""))),
    ]

    def host(now_ms):
        while todo and now_ms >= todo[0][0]:
            todo.pop(0)[1]()

    world.host = host


world = World()
