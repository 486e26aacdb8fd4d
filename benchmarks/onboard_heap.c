/* The least memory with which Lua loads a script and starts it: bytes above the libraries, 8 more for each block.
   gcc -m32 -DLUA_32BITS with the sources of Lua 5.3 but lua.c and luac.c; benchmarks/onboard.py does so. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "lauxlib.h"
#include "lua.h"
#include "lualib.h"

static const char *autopilot =
    "local one = function() return 1 end "
    "local any = setmetatable({}, { __index = function() return one end }) "
    "servo_telem, gcs, logger, arming, SRV_Channels = any, any, any, any, any "
    "param = { get = function() end, add_table = one, add_param = one } "
    "micros, Parameter = function() return any end, function() return any end";
static size_t used, limit;

/* A block that grows is a new one beside the old, as in a heap without room behind it. */
static void *memory(void *unused, void *old, size_t before, size_t after) {
  size_t held = old ? before + 8 : 0, wanted = after ? after + 8 : 0;
  void *block = NULL;
  if (after && wanted > held && used + wanted > limit) return NULL;
  if (after) block = malloc(after);
  if (old && block) memcpy(block, old, before < after ? before : after);
  free(old);
  used = used + wanted - held;
  return block;
}

static int starts(const char *path, size_t room) {
  lua_State *lua;
  int fails;
  used = 0, limit = (size_t)1 << 30;
  lua = lua_newstate(memory, NULL);
  luaL_openlibs(lua);
  fails = luaL_dostring(lua, autopilot);
  lua_gc(lua, LUA_GCCOLLECT, 0);
  limit = used + room;
  fails = fails || luaL_loadfile(lua, path) || lua_pcall(lua, 0, 0, 0);
  limit = (size_t)1 << 30;
  if (fails && room > 900000) fprintf(stderr, "%s\n", lua_tostring(lua, -1));
  lua_close(lua);
  return !fails;
}

int main(int count, char **words) {
  size_t low = 0, high = 1000000;
  if (count != 2 || !starts(words[1], high)) return 1;
  while (high - low > 50) {
    size_t middle = (low + high) / 2;
    *(starts(words[1], middle) ? &high : &low) = middle;
  }
  printf("%zu\n", high);
  return 0;
}
