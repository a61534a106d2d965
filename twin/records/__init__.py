"""Reads and writes records: recordings, sessions, LeRobot's data sets, Hugging Face's folders of pictures, and MCAP files of ROS 2.

``open_records`` reads any of these formats. ``convert`` translates between them. ``KeptAlso`` keeps a record in further formats while it is
being made.
"""

from twin.records.convert import ALSO, FORMATS, Converted, KeptAlso, convert, open_records, open_writer, with_pins
from twin.records.record import CHANNELS, About, Episode, RecordError, Records, RecordStep
