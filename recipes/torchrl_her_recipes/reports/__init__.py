"""Reports: what a study's runs say together."""
