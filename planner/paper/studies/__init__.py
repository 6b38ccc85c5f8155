"""The paper beside ours: one study per part of it, and the page that they make together."""
