"""The only code that imports rclpy or touches rcl."""
