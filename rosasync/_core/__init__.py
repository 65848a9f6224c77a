"""The parts of an open session, and what they need from rclpy."""
