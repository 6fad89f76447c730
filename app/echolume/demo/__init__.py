"""The demo: the whole system on the emulated rig, from calibration to scored map."""
