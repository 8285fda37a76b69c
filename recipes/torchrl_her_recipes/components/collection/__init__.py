"""Collection of experience in separate processes, on this machine or on the nodes of a Ray cluster."""
