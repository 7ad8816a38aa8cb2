"""Stages behind printers' controllers: Marlin."""
