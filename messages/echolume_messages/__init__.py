"""What crosses between the rooms: topics, messages, codec, bus, clock, geometry, calibration, errors."""
