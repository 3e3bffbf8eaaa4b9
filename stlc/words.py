"""Names for runs that can be remembered and said aloud."""

from __future__ import annotations

import secrets

_ADJECTIVES = """
    able amber ample azure blunt bold brisk broad calm candid clear coral crisp deft dusky eager
    early even fair fleet fresh gentle glad golden grand green hardy hazel honest humble jolly keen
    kind level light lively lucid lunar mellow merry mild misty modest neat nimble noble open
    patient plain polar prompt proud quick quiet rapid ready robust rosy rustic sandy serene sharp
    silent silver sleek smooth solid sound spry steady still stout sunny supple swift tall tawny
    tidy timely tranquil true upbeat vivid warm wary wise witty
"""
_ANIMALS = """
    adder alpaca auk badger bat beaver bee bison boar bobcat bream bunting buzzard carp civet cod
    condor coot crane cricket crow curlew deer dipper dolphin dove duck dunlin eagle egret eider elk
    ermine falcon ferret finch fox gannet gecko goose goshawk grebe grouse gull hare harrier hawk
    hedgehog heron hoopoe ibex ibis jackdaw jay kestrel kite lark lemur linnet lizard llama loon
    lynx magpie marten merlin mole moose moth newt ocelot orca oriole osprey otter owl panda pika
    pike plover puffin quail raven robin salmon seal shrew siskin skua snipe sparrow stoat stork
    swallow swan swift tapir teal tern thrush toad trout turtle vole walrus warbler weasel whale
    wigeon wolf wombat wren yak zebra
"""


def draw_words() -> str:
    """Two words, such as `quiet-heron`. Independent of every seed of an experiment."""
    return f"{secrets.choice(_ADJECTIVES.split())}-{secrets.choice(_ANIMALS.split())}"
