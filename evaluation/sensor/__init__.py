"""Tables and figures for the design of a sensor."""
