"""The throwing and reaching tasks."""
