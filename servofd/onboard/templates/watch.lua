--[[
   {{ file }}: tells which servo of {{ aircraft or "this aircraft" }} does not follow its command.

   Made by `servofd onboard` {{ version }} for ArduPilot 4.6 or newer with servo feedback. It reads outputs and positions,
   sends text and logs SFD messages; it never commands anything.

   Copy it to APM/scripts on the SD card, set SCR_ENABLE = 1 (and SCR_HEAP_SIZE = {{ plan.heap_bytes }} or more) and reboot.
   Parameters, to be seen after that:
     SFD_STREAM_HZ  how often each position is sent to the ground, as SRVP1, SRVP2, ... [Hz]; 0: never
     SFD_CHECK      arming is refused: 0 never, 1 while a servo does not follow, 2 until all have moved and followed

   For each surface a model of the healthy servo runs beside the real one. What differs is compared with what good servos
   differ by: three positions in a row, or its energy over 0.5 and 2 s, are an alarm. `servofd audit` does the same.
--]]

-- Angles in degrees, rates in degrees per second (up, down, and of a slower motor), times in microseconds.
-- Each mode of a servo has four numbers: decay [1/s], turn [rad/s], weight, weight of the turning part; behind these stand
-- its state (5, and 6 for the turning part) and that of the same mode as it follows the model (7, 8).
-- `doubt` is the root of the covariance of what good servos leave: rows of what grows with an offset, the deflection, its
-- rate, how far it is from each mode, and what a slower motor leaves; from the diagonal on. Text takes less
-- memory than numbers while a script is read. A surface takes 1.3 kB while it has no more than 64 settings and states.
local SURFACES = {
{%- for surface in plan.surfaces %}
   { {{ surface | lua_entry }} },
{%- endfor %}
}

local PERIOD_MS, TURNS = {{ plan.period_ms }}, {{ plan.turns }} -- each surface is looked at once a period, some of them at each turn

local CRITICAL, WARNING = 2, 4
local abs, max, min = math.abs, math.max, math.min

-- What is worked on; nothing is allocated in flight.
local keep_re, keep_im, basis = {}, {}, { 1.0 }

-- ---------------------------------------------------------------- the healthy servo

-- Move the model on to a later instant, under the command that it holds.
local function move(s, until_us)
   local step, pieces, modes, held, rates = (until_us - s.at_us) * 1e-6, 1, s.modes, s.held, s.rates
   if step <= 0.0 then
      return
   end
   s.at_us = until_us
   if rates then
      pieces = min(step // 0.004 + 1.0, 6.0) -- a rate limit acts piece by piece
      step = step / pieces
   end
   for k = 1, #modes do
      local m = modes[k]
      local keep = math.exp(-m[1] * step)
      keep_re[k], keep_im[k] = keep * math.cos(m[2] * step), -keep * math.sin(m[2] * step)
   end
   local position, weak = s.position, s.weak
   for _ = 1, pieces do
      local linear = 0.0
      for k = 1, #modes do
         local m = modes[k]
         local re, im, keep, turned = m[5] - held, m[6], keep_re[k], keep_im[k]
         m[5], m[6] = held + keep * re - turned * im, keep * im + turned * re
         linear = linear + m[3] * m[5] - m[4] * m[6]
      end
      if rates then
         position = max(min(linear, position + rates[1] * step), position - rates[2] * step)
         weak = max(min(linear, weak + rates[3] * step), weak - rates[3] * step)
      else
         position, weak = linear, linear
      end
   end
   s.position, s.weak = position, weak
end

-- Commands reach the servo a delay after they were given.
local function arrive(s, until_us)
   local due = s.due
   while s.first < s.last do
      local k = 2 * (s.first % (#due // 2))
      if until_us - due[k + 1] < 0 then
         return
      end
      if s.at_us then
         move(s, due[k + 1])
      end
      s.held, s.first = due[k + 2], s.first + 1
   end
   s.first, s.last = 0, 0
end

-- Start the model at rest where the surface was measured.
local function settle(s, now_us, measured)
   local modes, total = s.modes, 0.0
   for k = 1, #modes do
      total = total + modes[k][3]
   end
   for k = 1, #modes do
      local m = modes[k]
      m[5], m[6], m[7], m[8] = measured / total, 0.0, measured, 0.0
   end
   s.held = s.held or measured / total
   s.at_us, s.position, s.weak, s.simulated, s.judged_us = now_us, measured, measured, measured, now_us
   s.start_us, s.peak, s.short, s.long, s.row = now_us, 0.0, 0.0, 0.0, 0
end

-- ---------------------------------------------------------------- what a healthy servo may leave

-- Its standard deviation: how far good servos differ, and the noise of the reading, which is larger in fast motion (that of
-- the last 0.15 s or so).
local function deviation(s, simulated, weak, step)
   local modes, rates, before, quick, turned = s.modes, s.rates, s.simulated, 0.0, 0.0
   for k = 1, #modes do
      local m = modes[k]
      local h, g, both = 0.5 * step * m[1], 0.5 * step * m[2], simulated + before
      local re = (1.0 - h) * m[7] + g * m[8] + h * both
      local im = (1.0 - h) * m[8] - g * m[7] + g * both
      local size = (1.0 + h) * (1.0 + h) + g * g
      m[7], m[8] = (re * (1.0 + h) + im * g) / size, (im * (1.0 + h) - re * g) / size
      quick = quick + (g == 0.0 and 1.0 or 2.0) * (simulated - m[7])
      turned = g ~= 0.0 and m[8] or k == 1 and quick or turned
   end
   local speed, aimed = (simulated - before) / step, abs(s.held * s.dc_gain - simulated) / s.lag
   s.simulated = simulated
   s.peak = max(abs(speed), rates and min(aimed, rates[1]) or aimed, s.peak / (1.0 + step / 0.15))
   basis[2], basis[3], basis[4], basis[5], basis[6] = simulated, speed, quick, turned, simulated - weak
   local doubt, at, variance = s.doubt, 0, s.noise * s.noise + s.jitter * s.peak * s.jitter * s.peak
   for i = 1, 6 do
      local row = 0.0
      for j = i, 6 do
         at = at + 1
         row = row + doubt[at] * basis[j]
      end
      variance = variance + row * row
   end
   return math.sqrt(variance)
end

-- ---------------------------------------------------------------- alarms

-- The surface that alarmed last, until it has a name or 2 s are over. What it did, what was asked of it, and the difference:
-- least, largest, where it last turned, how far it went, where it began, sums of how far it was from there and their squares.
local suspect, since_us, towards, products, count = nil, 0, 0.0, 0.0, 0.0
local did, asked, apart = {}, {}, {}

local function begin(seen, value)
   seen[1], seen[2], seen[3], seen[4], seen[5], seen[6], seen[7] = value, value, value, 0.0, value, 0.0, 0.0
end

local function note(seen, value, noise)
   local step, away = value - seen[3], value - seen[5]
   seen[1], seen[2] = min(seen[1], value), max(seen[2], value)
   step = abs(step) > noise and step or 0.0
   seen[3], seen[4] = seen[3] + step, seen[4] + abs(step)
   seen[6], seen[7] = seen[6] + away, seen[7] + away * away
   return step, away
end

local function name_it(s, now_us, measured, simulated, residual, sure)
   local age_us, noise = now_us - since_us, 4.0 * s.noise + s.resolution
   if age_us < 400000 then -- a hardover is still on its way
      begin(did, measured)
      begin(asked, simulated)
      begin(apart, residual)
      towards, products, count = 0.0, 0.0, 0.0
      return
   end
   local step, away = note(did, measured, noise)
   local _, wanted = note(asked, simulated, noise)
   note(apart, residual, noise)
   towards = towards + (s.held > measured and step or -step)
   products, count = products + away * wanted, count + 1.0
   local span, range = asked[2] - asked[1], did[2] - did[1]
   if span < max(2.0 * sure, 3.0 * noise) and age_us < 1900000 then
      return
   end
   suspect = nil
   local middle, kind, size = 0.5 * (did[1] + did[2]), nil, 0.0
   local both, own = products - did[6] * asked[6] / count, did[7] - did[6] * did[6] / count
   local slope = both / max(asked[7] - asked[6] * asked[6] / count, 1e-6)
   if range <= 1.5 * noise then
      if middle >= 0.9 * s.reach_high or middle <= 0.9 * s.reach_low then
         kind, size = "%s hardover %.1f deg", middle
      elseif span >= max(0.7 * sure, 2.0 * noise) then
         kind, size = "%s stuck %.1f deg", middle
      end
   elseif apart[2] - apart[1] <= max(1.5 * noise, 0.25 * span) and abs(residual) >= 0.33 * sure then
      kind, size = "%s offset %+.1f deg", 0.5 * (apart[1] + apart[2])
   elseif did[4] > 1.5 * asked[4] then
      kind, size = "%s moves by itself +-%.1f deg", 0.5 * range
   elseif span >= 1.4 * sure and slope * both < 0.25 * own then
      kind = "%s floating"
   elseif slope * both >= 0.95 * own and slope < 0.85 then
      kind, size = "%s moves %.0f%% of its way", 100.0 * slope
   elseif did[4] > 0.0 and towards >= 0.85 * did[4] and asked[4] > 1.3 * did[4] then
      kind = "%s slow"
   end
   -- A fault that lasts is named again only where the surface does not move at all any more.
   if kind and (s.alarm == true or (range <= 1.5 * noise and kind ~= s.alarm)) then
      gcs:send_text(CRITICAL, string.format(kind, s.name, size))
      s.alarm = kind
   elseif s.alarm == true then
      s.alarm = ""
   end
end

-- Readings that all stand still are no fault of one servo: drivers repeat the last ones of a frozen bus (Volz: for 5 s).
-- `held_back` is 1 while alarms wait for that, or 2 if the surface was off since.
local bus_told, thawed_us = false, 0

-- Whether all readings stand still: that is waited for a second, and is the bus if more than one servo is off by then.
local function frozen(suspected, now_us)
   local still_us, off = 1000000, 0
   for i = 1, #SURFACES do
      still_us = min(still_us, now_us - SURFACES[i].changed_us)
   end
   if still_us < 30000 or #SURFACES < 2 then -- a bus begins again one servo after the other
      return suspected.held_back > 0 and now_us - thawed_us < 100000
   end
   for i = 1, #SURFACES do
      local s = SURFACES[i]
      s.held_back = max(s.held_back, abs(s.row) >= s.persistence and 2 or 1)
      off = off + s.held_back - 1
   end
   if still_us == 1000000 and off > 1 and not bus_told then
      bus_told = true
      gcs:send_text(WARNING, "servos: positions stand still")
   end
   return still_us < 1000000 or off > 1
end

-- Raise an alarm, or take it back: within 0.8 s the model has moved by 6 deviations or more, as fast as when it last became
-- loud, and the residual by less than 0.45 of that, quietly. A residual counts for 6 deviations at most.
local function decide(s, now_us, residual, sigma, measured, simulated, step)
   local level, size, quiet, ratio, sure = s.limit * sigma, abs(residual), s.quiet, residual / sigma, min(6.0, 1.5 * s.limit)
   local energy = min(ratio * ratio, 36.0)
   s.short = s.short + (energy - s.short) * min(4.0 * step, 0.3)
   s.long = s.long + (energy - s.long) * min(step, 0.1)
   quiet[2], quiet[3] = min(quiet[2], simulated), max(quiet[3], simulated)
   quiet[4], quiet[5], quiet[6] = min(quiet[4], residual), max(quiet[5], residual), max(quiet[6], s.peak)
   quiet[7], quiet[8] = quiet[7] + sigma, quiet[8] + 1.0
   local loud = size >= 0.5 * level or s.short >= 0.25 * s.energies[1]
   if loud or now_us - quiet[1] >= 800000 then
      local way = quiet[3] - quiet[2]
      if s.alarm and not loud and quiet[6] >= s.brisk and way * quiet[8] >= sure * quiet[7]
         and quiet[5] - quiet[4] <= 0.45 * way then
         s.alarm, s.long = false, s.short
         gcs:send_text(WARNING, s.name .. " follows again")
      end
      if loud and not s.loud then -- what moves no faster than this proves nothing
         s.brisk = min(s.brisk, s.peak)
      end
      s.loud = loud
      quiet[1], quiet[2], quiet[3], quiet[4], quiet[5], quiet[6] = now_us, simulated, simulated, residual, residual, 0.0
      quiet[7], quiet[8] = 0.0, 0.0
   end
   local side = size < level and 0 or residual > 0.0 and 1 or -1
   s.row = s.row * side > 0 and s.row + side or side
   local over = abs(s.row) >= s.persistence or s.short >= s.energies[1] or s.long >= s.energies[2]
   if over and not s.alarm and not frozen(s, now_us) then
      s.alarm, s.brisk, suspect, since_us = true, s.peak, s, now_us
      gcs:send_text(CRITICAL, string.format("%s off by %+.1f deg", s.name, residual))
   elseif over and s.alarm and not suspect then -- has something worse followed?
      suspect, since_us = s, now_us
   end
   if suspect == s then
      name_it(s, now_us, measured, simulated, residual, sure * sigma)
   end
end

-- ---------------------------------------------------------------- one surface

local sending = false
local sent_us, between_us = 0, 40000

local function judge(s, now_us, measured)
   local simulated, weak, stops, step = s.position, s.weak, s.stops, (now_us - s.judged_us) * 1e-6
   if step <= 0.0 then
      return
   end
   s.judged_us = now_us
   if stops then
      simulated, weak = min(max(simulated, stops[1]), stops[2]), min(max(weak, stops[1]), stops[2])
   end
   local change = abs(measured - s.measured)
   if change > 0.0 and (s.resolution == 0.0 or change < s.resolution) then
      s.resolution = change
   end
   s.measured = measured
   local sigma, residual = deviation(s, simulated, weak, step), measured - simulated
   if s.start_us and (now_us - s.start_us) * 1e-6 >= 8.0 * s.lag then -- the model has forgotten how it was started
      s.start_us = nil
   end
   if not s.start_us then
      decide(s, now_us, residual, sigma, measured, simulated, step)
   else
      residual = 0.0 / 0.0
   end
   logger:write("SFD", "I,Cmd,Sim,Pos,Res,Thr", "Bfffff", "#ddddd", "------", s.output, s.command, simulated, measured,
                residual, s.limit * sigma)
end

local function hear(s, now_us, telemetry)
   local command
   if s.telemetry then
      command = telemetry and telemetry:command_position()
   else
      command = SRV_Channels:get_output_pwm_chan(s.output - 1)
      command = command and command > 0 and command - 1500
   end
   if s.command and now_us - s.heard_us > 250000 then
      s.at_us, s.command = nil, nil -- nobody knows what the servo did meanwhile
   end
   if not command then
      return
   end
   local deg, curve, bounds = s.gain * command + s.offset, s.curve, s.bounds
   if curve then
      deg = deg + command * command * (curve[1] + command * curve[2])
   end
   if bounds then
      deg = min(max(deg, bounds[1]), bounds[2])
   end
   if deg ~= s.command then
      local k = 2 * (s.last % (#s.due // 2))
      s.due[k + 1], s.due[k + 2] = now_us + s.delay_us, deg
      s.last = s.last + 1
   end
   s.command, s.heard_us = deg, now_us
   s.lowest, s.highest = min(s.lowest, deg), max(s.highest, deg)
end

local function watch(s, now_us)
   local telemetry = servo_telem:get_telem(s.output - 1)
   local raw, update_ms = nil, nil
   if telemetry then
      raw, update_ms = telemetry:measured_position(), telemetry:last_update_ms():toint()
   end
   local fresh = raw and raw == raw and update_ms ~= s.update_ms
   if fresh or not s.telemetry then -- a servo that is silent repeats no command either
      hear(s, now_us, telemetry)
   end
   arrive(s, now_us)
   if not fresh then
      return
   end
   s.update_ms, s.seen_us, s.silent = update_ms, now_us, false
   if raw ~= s.reading then
      s.reading, s.changed_us = raw, now_us
      if s.held_back > 0 then -- what it did meanwhile nobody knows
         s.held_back, bus_told, thawed_us, s.at_us = 0, false, now_us, nil
      end
   end
   if sending then
      gcs:send_named_float(s.stream, raw)
   end
   if not s.command or (raw == s.reading and now_us ~= s.changed_us and now_us - s.changed_us < 150000) then
      return -- a reading that the bus repeats may be an old one; a surface that stands still is judged a moment later
   end
   local measured = s.sense * raw + s.zero
   if s.at_us then
      move(s, now_us)
      judge(s, now_us, measured)
   else
      settle(s, now_us, measured)
   end
end

-- ---------------------------------------------------------------- all surfaces

-- Positions that stop are told once: of all servos together if all have stopped, for that is one cause.
local function silence(now_us)
   local silent, new = 0, nil
   for i = 1, #SURFACES do
      local s = SURFACES[i]
      if now_us - s.seen_us > 1000000 then
         silent = silent + 1
         if not s.silent then
            s.silent, new = true, s
         end
      end
   end
   if new then
      local all = silent == #SURFACES and silent > 1
      gcs:send_text(WARNING, all and "servos: no positions" or new.name .. " no position")
   end
end

-- Arming: a surface that alone is a reason to refuse, and which one.
local function refusal(check)
   for i = 1, #SURFACES do
      local s = SURFACES[i]
      if s.alarm then
         return s, "did not follow"
      elseif s.silent then
         return s, "no position"
      elseif check > 1 and s.highest - s.lowest < min(0.3 * (s.reach_high - s.reach_low), 10.0) then
         return s, "not moved by sticks"
      end
   end
end

local auth_id, refused, why, check_parameter, stream_parameter = nil, nil, "", nil, nil

local function check_arming()
   local check = check_parameter and check_parameter:get() or 0
   if check > 0 and not auth_id then
      auth_id, why = arming:get_aux_auth_id(), ""
   end
   if not auth_id then
      return
   end
   local s, reason = nil, nil
   if check > 0 then
      s, reason = refusal(check)
   end
   if s ~= refused or reason ~= why then
      refused, why = s, reason
      if s then
         arming:set_aux_auth_failed(auth_id, s.name .. " " .. reason)
      else
         arming:set_aux_auth_passed(auth_id)
      end
   end
end

local turn, calls = 0, 0

local function update()
   local now_us = micros():toint()
   if turn == 0 then
      sending = between_us > 0 and now_us - sent_us >= between_us
      sent_us = (sending or between_us == 0) and now_us or sent_us
   end
   for i = turn + 1, #SURFACES, TURNS do
      watch(SURFACES[i], now_us)
   end
   turn = (turn + 1) % TURNS
   calls = calls + 1
   if calls * PERIOD_MS >= 250 * TURNS then
      calls = 0
      silence(now_us)
      check_arming()
      local hz = stream_parameter and stream_parameter:get() or 25.0
      between_us = hz > 0.0 and 1000000 // hz - 500 * PERIOD_MS or 0
   end
end

local function protected()
   local fine, reason = pcall(update)
   if fine then
      return protected, PERIOD_MS // TURNS
   end
   gcs:send_text(CRITICAL, string.sub("servofd stopped: " .. tostring(reason), 1, 50))
end

-- ---------------------------------------------------------------- once

-- Settings of a surface from its lines, lists where there are several numbers; and what is wrong with them: they may have
-- been edited by hand, and it is said now, not in flight.
local function read(lines)
   local s = {}
   for _, line in ipairs(lines) do
      for key, text in string.gmatch(line, "(%S+)=(%S+)") do
         local list = {}
         for word in string.gmatch(text, "[^,]+") do
            if not tonumber(word) then
               list = {}
               break
            end
            list[#list + 1] = tonumber(word)
         end
         s[key] = key == "name" and text or list
      end
   end
   if #(s.name or "") < 1 or #s.name > {{ longest_name }} then
      return s, "a name: 1 to {{ longest_name }} letters"
   end
   for key, count, free in string.gmatch("output1 gain1 offset1 sense1 zero1 delay_us1 dc_gain1 lag1 noise1 jitter1 limit1 "
                                         .. "persistence1 energies2 modes4 doubt21 rates3? bounds2? stops2? curve2?",
                                         "(%D+)(%d+)(%??) ?") do
      local list, n = s[key], tonumber(count)
      if list and #list ~= n and (key ~= "modes" or #list == 0 or #list % n > 0) or not list and free == "" then
         return s, s.name .. ": " .. key .. ": " .. n .. (n > 1 and " numbers" or " number")
      end
      s[key] = n == 1 and list[1] or list
   end
   return s
end

local function prepare(s, now_us)
   local flat = s.modes
   s.modes = {}
   for k = 4, #flat, 4 do
      s.modes[k // 4] = { flat[k - 3], flat[k - 2], flat[k - 1], flat[k], 0.0, 0.0, 0.0, 0.0 }
   end
   s.due = {}
   for k = 1, 2 * (s.delay_us // (PERIOD_MS * 1000) + 3) do -- commands on their way, and when they arrive
      s.due[k] = 0.0
   end
   for key in string.gmatch("position weak simulated measured peak short long first last resolution row "
                            .. "held_back reading", "%S+") do
      s[key] = 0
   end
   s.quiet = { now_us, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0 }
   s.alarm, s.silent, s.loud, s.brisk = false, false, false, 0.0 -- a table that grows in flight would have to be copied
   s.seen_us, s.changed_us, s.lowest, s.highest = now_us, now_us, 1e9, -1e9
   s.stream = "SRVP" .. s.output
   s.reach_low, s.reach_high = -1e9, 1e9
   if not s.telemetry then
      local a = s.gain * ((param:get("SERVO" .. s.output .. "_MIN") or 1000) - 1500.0) + s.offset
      local b = s.gain * ((param:get("SERVO" .. s.output .. "_MAX") or 2000) - 1500.0) + s.offset
      s.reach_low, s.reach_high = min(a, b), max(a, b)
   end
end

local wrong = not servo_telem and "needs ArduPilot 4.6 with servo telemetry"
for i = 1, wrong and 0 or #SURFACES do
   local odd
   SURFACES[i], odd = read(SURFACES[i])
   wrong = wrong or odd
end
if wrong then
   gcs:send_text(CRITICAL, "servofd: " .. wrong)
   return
end
for i = 1, #SURFACES do
   prepare(SURFACES[i], micros():toint())
end
if param:add_table({{ plan.table_key }}, "SFD_", 2) and param:add_param({{ plan.table_key }}, 1, "STREAM_HZ", 25)
   and param:add_param({{ plan.table_key }}, 2, "CHECK", 0) then
   stream_parameter, check_parameter = Parameter("SFD_STREAM_HZ"), Parameter("SFD_CHECK")
else
   gcs:send_text(WARNING, "servofd: no room for its parameters")
end
gcs:send_text(6, "servofd watches " .. #SURFACES .. " servos")
return protected, PERIOD_MS // TURNS
