/* What a step of the world consists of: robots look around, write what they see into their maps, and
 * merge them. Bools are a byte each, 0 or 1. */
#ifndef MARL_EXPLORE_WORLD_H
#define MARL_EXPLORE_WORLD_H

#include "grid.h"

enum { OPEN = 0, WALL = 1, ROBOT = 2, UNSEEN = 4 }; /* what surroundings hold, a bit each */

/* What is around robots; bools are a byte each, 0 or 1. */
typedef struct {
    const int8_t *walls;   /* [arenas, cells], obstacles with a border of UNSEEN */
    const int64_t *own;    /* [arenas, team], each robot's cell in it */
    const int64_t *people; /* [arenas, num_people], those of people, who look like robots */
    const uint8_t *masks;  /* [num_kinds, side, side], the shapes of sensors */
    int8_t *view;          /* [arenas, team, side, side], the answers */
    int64_t team, num_people, cells, width, num_kinds, side; /* of a bordered arena */
    int64_t hides; /* whether obstacles end sight */
} Looks;

/* What robots write into their maps. */
typedef struct {
    const int8_t *view;      /* [arenas, team, side, side], their surroundings */
    const int64_t *position; /* [arenas, team, 2], row and column */
    const uint8_t *alive;    /* [arenas, team], whose maps change; NULL: all */
    const uint8_t *target;   /* [arenas, height, width], cells that are counted apart */
    int8_t *maps;            /* [arenas, team, height, width] */
    int64_t *discovered;     /* [arenas, team], cells that were unknown */
    int64_t *targets;        /* [arenas, team], the targets among them */
    int64_t team, height, width, side;
} Readings;

/* The teams of a batch; bools are a byte each, 0 or 1. */
typedef struct {
    const uint8_t *linked;        /* [arenas, team, team] */
    const uint8_t *communicating; /* [arenas, team] */
    const uint8_t *target;        /* [arenas, cells], cells that are counted apart */
    int8_t *maps;                 /* [arenas, team, cells], which are merged */
    uint8_t *network;             /* [arenas, team, team], pairs in one network; 0 before the call */
    int64_t *received;            /* [arenas, team], cells that were unknown; 0 before the call */
    int64_t *targets;             /* [arenas, team], the targets among them; 0 before the call */
    int64_t team, cells;
} Teams;

int marl_explore_surroundings(const Looks *looks, int64_t first, int64_t last);
int marl_explore_sense(const Readings *readings, int64_t first, int64_t last);
int marl_explore_merge(const Teams *teams, int64_t first, int64_t last);

#endif
