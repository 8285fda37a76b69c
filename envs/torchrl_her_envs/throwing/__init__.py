"""The throwing and reaching tasks; contacts and bounces by pymunk, all else as array code."""
