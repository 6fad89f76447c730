"""The message bus: data as puts that never wait, gaps refilled from journals, commands as queries."""

from echolume_messages.bus.client import Bus, connect
from echolume_messages.bus.message import Message
from echolume_messages.bus.publisher import Publisher
from echolume_messages.bus.subscription import Subscription

__all__ = ["Bus", "Message", "Publisher", "Subscription", "connect"]
