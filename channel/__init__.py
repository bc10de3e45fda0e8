"""Everything between the sites: packet, link, delay injection, round trip and clock offset."""
