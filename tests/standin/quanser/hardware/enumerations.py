"""Numbers of Quanser's HIL interface, under its names."""


class Clock:
    HARDWARE_CLOCK_0 = 0


class BufferOverflowMode:
    ERROR_ON_OVERFLOW = 0
    OVERWRITE_ON_OVERFLOW = 1
    DISCARD_ON_OVERFLOW = 2
    WAIT_ON_OVERFLOW = 3
