"""From recordings of known things to what the sensor is: references, lens, zenith, precession, gel."""
