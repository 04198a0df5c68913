"""The MCAP file: kinds of messages, writer, reader, what is kept private."""
