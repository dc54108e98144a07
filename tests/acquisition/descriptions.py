"""Descriptions of robots without drives, for tests."""

ONE_JOINT = """
name = "one"
[[joint]]
name = "axis"
type = "revolute"
dh = { alpha_deg = 0, d_m = 0, theta_deg = 0, r_m = 0 }
[[motor]]
name = "motor"
ratio = 50
drive_gain = 0.2
drive_gain_unit = "N m/A"
[controller]
bandwidth_hz = 20
"""
COUPLED = """
name = "coupled"
motor_matrix = [[10, 4], [-3, 20]]
gravity_m_s2 = [0, 9.81, 0]
[[joint]]
name = "first"
type = "revolute"
zero_deg = 90
dh = { alpha_deg = 0, d_m = 0, theta_deg = 0, r_m = 0 }
[[joint]]
name = "second"
type = "revolute"
zero_deg = -45
dh = { alpha_deg = 0, d_m = 0, theta_deg = 0, r_m = 0 }
[[motor]]
name = "m1"
drive_gain = 0.5
drive_gain_unit = "N m/A"
[[motor]]
name = "m2"
drive_gain = 0.25
drive_gain_unit = "N m/A"
[controller]
bandwidth_hz = 20
"""
