"""What runs on a MicroPython robot that measures by itself, copied onto it as it is, paths and all.

Fill in ``hardware.py`` first. With ``mpremote``, from the checkout::

    mpremote mkdir :robot
    mpremote cp robot/__init__.py robot/onboard.py :robot/
    mpremote cp -r robot/micropython :robot/
    mpremote cp robot/micropython/main.py :main.py
    mpremote reset
"""
