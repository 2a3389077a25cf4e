"""The physics of a rig: shapes, materials, pads, contact, bodies, actuators, and the multibond
graph they make."""
