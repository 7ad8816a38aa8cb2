"""A rig file to begin with."""

TEMPLATE = """\
# A rig for mirrorskin: what moves the sensor's body, and what looks at its skin (docs/rig.md).
# Lines that begin with # show what may be said as well.

name = "bench"

[stage]
port = "/dev/ttyUSB0"           # or COM3, socket://192.168.0.7:23, rfc2217://host:port
# baud = 115200
home = true                     # the stage has switches, and must home before it moves
# timeout = 2.0                 # s that an answer may take
# report_rate = 20.0            # Hz: how often it is asked where it rests
press = 2.0                     # mm: greatest travel, whatever the axis could do
# pivot = [0.0, 0.0, 0.0]       # mm from the centre of the sheet: what the body turns about

[stage.travel]                  # mm, positive down, 0 where the skin is just above the object
letter = "Z"
direction = -1                  # this machine counts upwards
zero = -20.0                    # the machine's coordinate at which the travel is 0
# unit = "mm"
limits = [-10.0, 3.0]
speed = 5.0                     # mm/s

[stage.pitch]                   # degrees, 0 upright; leave pitch and roll out if the stage only presses
letter = "X"
direction = 1
zero = 0.0
# unit = "deg"
limits = [-5.0, 5.0]
speed = 20.0                    # degrees/s

[stage.roll]
letter = "Y"
direction = 1
zero = 0.0
# unit = "deg"
limits = [-5.0, 5.0]
speed = 20.0

[camera]
source = 0                      # a camera's number, or a file or URL in quotes
size = [640, 480]               # columns, rows
# name = "left"                 # what recordings and calibrations call it; without it, the source
# dtype = "uint8"
# fourcc = "GREY"
# exposure = 0.004              # s
# gain = 1.0
# rate = 60.0                   # Hz
# delay = 0.03                  # s from the middle of the exposure to the frame's arrival, if it is known
pixel_size = 0.03               # mm at the sheet
# dark = 12                     # counts without light, or a picture's file
# bright = "bright.tif"         # counts in full light, or a picture's file
# zenith_gain = 5.7             # counts per degree of zenith
# zenith_offset = 10            # counts at zenith 0
"""
"""Says every key; what is left out has its default."""
