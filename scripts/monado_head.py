"""Holds the head of Monado's "remote" headset where a file says, until it is ended: monado_head.py FILE.

The file has one line: x y z in metres, and the degrees by which the head is turned left. The packet is that of Monado 25:
both eyes (frustum, pose in the head, pad), the head's pose, then two controllers, which are not there."""
import math
import socket
import struct
import sys
import time

PORT = 4242
EYE = '4f7fI'
CONTROLLER = '7f3f3f5f' + 'fff2ff2f' + '13?3x'
PACKET = '<8s' + EYE * 2 + '7f?3x' + CONTROLLER * 2
ABSENT = (0, 0, 0, 1, 0, 0, 0) + (0,) * 19 + (False,) * 13
FRUSTUM = (-0.7, 0.7, 0.7, -0.7)


def packet(x, y, z, yaw_deg):
    half = math.radians(yaw_deg) / 2
    eye = (*FRUSTUM, 0, 0, 0, 1, 0, 0, 0, 0)
    head = (0, math.sin(half), 0, math.cos(half), x, y, z, False)
    return struct.pack(PACKET, b'mndrmt3\0', *eye, *eye, *head, *ABSENT, *ABSENT)


def hold(file):
    with socket.create_connection(('127.0.0.1', PORT)) as hub:
        while True:
            with open(file) as pose:
                hub.sendall(packet(*map(float, pose.read().split())))
            time.sleep(0.02)


while True:
    try:
        hold(sys.argv[1])
    except OSError:  # the service has not begun, or has ended
        time.sleep(0.2)
