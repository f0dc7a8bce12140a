"""The real devices behind the Rig's Protocols; the only user of serial ports, HTTP and gphoto2."""
