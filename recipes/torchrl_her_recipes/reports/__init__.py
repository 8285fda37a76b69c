"""Reports: pages and tables about the runs of a study."""
