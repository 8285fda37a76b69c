"""Scripted controllers: they show that every task can be solved."""
