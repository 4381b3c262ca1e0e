"""Smart visual beacons: an event camera finds blinking LEDs, follows them and reads what they say."""
