// Print the markers that a gateway publishes on LCM.
//
//   make -C examples cpp && examples/build/subscriber_cpp [SOURCE [COUNT]]     for example: subscriber_cpp LAB 100
//
// Building needs a C++17 compiler, make, and the Python package lcm, which has LCM's library and lcm-gen. SOURCE is the
// name of the source in upper case. The program stops after COUNT frames. The environment variable LCM_DEFAULT_URL sets
// the LCM URL. With --vectors, the program decodes messages from standard input instead (lcm_types/vectors/README.md).
#include <clocale>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <cwchar>
#include <iostream>
#include <lcm/lcm-cpp.hpp>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <sys/resource.h>
#include <type_traits>
#include <vector>

#include "rtc3d/analog_t.hpp"
#include "rtc3d/clock_t.hpp"
#include "rtc3d/command_reply_t.hpp"
#include "rtc3d/command_request_t.hpp"
#include "rtc3d/events_t.hpp"
#include "rtc3d/forces_t.hpp"
#include "rtc3d/markers_t.hpp"
#include "rtc3d/parameters_reply_t.hpp"
#include "rtc3d/parameters_request_t.hpp"
#include "rtc3d/parameters_t.hpp"
#include "rtc3d/status_t.hpp"
#include "rtc3d/take_details_t.hpp"
#include "rtc3d/take_end_t.hpp"
#include "rtc3d/take_t.hpp"
#include "rtc3d/tool_pose_t.hpp"
#include "rtc3d/tools_t.hpp"

// The bytes of one item of a component message; 0 for other types.
template <class Message> constexpr std::size_t item_bytes = 0;
template <> constexpr std::size_t item_bytes<rtc3d::markers_t> = 16;
template <> constexpr std::size_t item_bytes<rtc3d::tools_t> = 32;
template <> constexpr std::size_t item_bytes<rtc3d::analog_t> = 4;
template <> constexpr std::size_t item_bytes<rtc3d::forces_t> = 24;
template <> constexpr std::size_t item_bytes<rtc3d::events_t> = 24;

// Return the message, or nothing if these bytes are not one. Component messages must have as many bytes as they say
// that they have items: the functions of lcm-gen allocate memory for the items before they look. They do not look at
// the NUL at the end of a text either, so other messages must have the same bytes when they are encoded again.
template <class Message> std::optional<Message> decode(const void *data, std::size_t size)
{
    if constexpr (item_bytes<Message> != 0) {
        const auto *count = static_cast<const unsigned char *>(data) + 52;
        if (size < 56)
            return {};
        const std::size_t items = std::size_t{count[0]} << 24 | count[1] << 16 | count[2] << 8 | count[3];
        if (items * item_bytes<Message> != size - 56)
            return {};
    }
    try {
        Message message;
        if (message.decode(data, 0, static_cast<int>(size)) != static_cast<int>(size))
            return {};
        std::string again(size, '\0');
        if (item_bytes<Message> != 0 || (message.encode(&again[0], 0, static_cast<int>(size)) >= 0 &&
                                         std::memcmp(again.data(), data, size) == 0))
            return message;
    } catch (const std::exception &) { // a text with an impossible length
    }
    return {};
}

class Subscriber
{
public:
    long num_frames = 0;

    void on_markers(const lcm::ReceiveBuffer *buffer, const std::string &channel)
    {
        const auto message = decode<rtc3d::markers_t>(buffer->data, buffer->data_size);
        if (!message) {
            std::cerr << "ignored a malformed message on " << channel << "\n";
            return;
        }
        const rtc3d::marker_t *first = nullptr;
        int visible = 0;
        for (const auto &marker : message->markers) {
            if (std::isnan(marker.x))
                continue;
            visible++;
            if (!first)
                first = &marker;
        }
        std::printf("#%lld frame %d at %.4f s with parameters %d: %d of %d markers in view",
                    static_cast<long long>(message->sequence), message->frame_number, message->timestamp / 1e6,
                    message->parameters_version, visible, message->num_markers);
        if (first)
            std::printf(", the first at %.3f, %.3f, %.3f mm", first->x, first->y, first->z);
        std::printf("\n");
        std::fflush(stdout);
        num_frames++;
    }
};

int subscribe(const std::string &source, long count)
{
    lcm::LCM lcm;
    if (!lcm.good()) {
        std::cerr << "Cannot open LCM; check $LCM_DEFAULT_URL and the multicast route\n";
        return 1;
    }
    Subscriber subscriber;
    lcm.subscribe("MOCAP_" + source + "_3D", &Subscriber::on_markers, &subscriber)
        ->setQueueCapacity(1000); // the default of 30 loses frames whenever this program pauses
    std::cout << "listening" << std::endl;
    while ((count == 0 || subscriber.num_frames < count) && lcm.handle() == 0) {
    }
    return 0;
}

// The rest is for --vectors: any message as JSON.
class Json
{
public:
    std::ostringstream out;

    // Write a field.
    template <class Value> Json &operator()(const char *name, const Value &value)
    {
        out << (is_first ? "{\"" : ", \"") << name << "\": ";
        is_first = false;
        write(value);
        return *this;
    }

    void write(std::int64_t value) { out << value; }
    void write(std::int32_t value) { out << value; }
    void write(std::int8_t value) { out << (value ? "true" : "false"); } // LCM's boolean
    void write(float value) { write_number(value, 9); }
    void write(double value) { write_number(value, 17); }

    void write(const std::string &value)
    {
        if (!is_utf8(value))
            throw std::invalid_argument("a text is not UTF-8");
        out << '"';
        for (const char letter : value) {
            char escaped[7];
            if (static_cast<unsigned char>(letter) < ' ') {
                std::snprintf(escaped, sizeof escaped, "\\u%04x", letter);
                out << escaped;
            } else {
                if (letter == '"' || letter == '\\')
                    out << '\\';
                out << letter;
            }
        }
        out << '"';
    }

    template <class Item> void write(const std::vector<Item> &items) { write_items(items.data(), items.size()); }
    template <class Item, std::size_t size> void write(const Item (&items)[size]) { write_items(items, size); }

    template <class Struct, class = std::enable_if_t<std::is_class_v<Struct>>> void write(const Struct &value)
    {
        is_first = true;
        write_fields(*this, value);
        out << '}';
        is_first = false;
    }

private:
    bool is_first = true;

    // Return whether a text is UTF-8, in a locale that is, and has no NUL.
    static bool is_utf8(const std::string &text)
    {
        std::mbstate_t state{};
        wchar_t letter = 0;
        for (std::size_t i = 0, size = 0; i < text.size(); i += size) {
            size = std::mbrtowc(&letter, &text[i], text.size() - i, &state);
            if (size == 0 || size > text.size() - i || letter > 0x10ffff)
                return false;
        }
        return true;
    }

    void write_number(double value, int digits)
    {
        char text[32];
        std::snprintf(text, sizeof text, "%.*g", digits, value);
        if (std::isfinite(value))
            out << text;
        else
            out << (std::isnan(value) ? "\"nan\"" : value > 0 ? "\"inf\"" : "\"-inf\"");
    }

    template <class Item> void write_items(const Item *items, std::size_t size)
    {
        out << '[';
        for (std::size_t i = 0; i < size; i++) {
            out << (i == 0 ? "" : ", ");
            write(items[i]);
        }
        out << ']';
    }
};

template <class Message> Json &write_prefix(Json &json, const Message &m)
{
    return json("utime", m.utime)("capture_utime", m.capture_utime)("sequence", m.sequence)("session", m.session)(
        "parameters_version", m.parameters_version);
}

template <class Message> Json &write_header(Json &json, const Message &m)
{
    return write_prefix(json, m)("frame_number", m.frame_number)("timestamp", m.timestamp);
}

void write_fields(Json &json, const rtc3d::marker_t &m)
{
    json("x", m.x)("y", m.y)("z", m.z)("reliability", m.reliability);
}

void write_fields(Json &json, const rtc3d::tool_t &m)
{
    json("q0", m.q0)("qx", m.qx)("qy", m.qy)("qz", m.qz)("x", m.x)("y", m.y)("z", m.z)("error", m.error);
}

void write_fields(Json &json, const rtc3d::force_t &m)
{
    json("fx", m.fx)("fy", m.fy)("fz", m.fz)("mx", m.mx)("my", m.my)("mz", m.mz);
}

void write_fields(Json &json, const rtc3d::event_t &m)
{
    json("id", m.id)("timestamp", m.timestamp)("param1", m.param1)("param2", m.param2)("param3", m.param3);
}

void write_fields(Json &json, const rtc3d::clock_model_t &m)
{
    json("has_clock", m.has_clock)("offset_us", m.offset_us)("drift_ppm", m.drift_ppm);
    json("uncertainty_us", m.uncertainty_us)("samples", m.samples);
}

void write_fields(Json &json, const rtc3d::count_t &m) { json("name", m.name)("count", m.count); }

void write_fields(Json &json, const rtc3d::loss_t &m)
{
    json("cause", m.cause)("messages", m.messages)("frames", m.frames);
}

void write_fields(Json &json, const rtc3d::stream_status_t &m)
{
    json("components", m.components)("state", m.state)("problem", m.problem)("tries", m.tries);
    json("byte_order", m.byte_order)("rate", m.rate)("frame_rate_hz", m.frame_rate_hz)("session", m.session);
    json("frames_in", m.frames_in)("bytes_in", m.bytes_in)("reconnects", m.reconnects)("restarts", m.restarts);
    json("lag_ms", m.lag_ms)("clock", m.clock)("num_drops", m.num_drops)("drops", m.drops);
    json("num_limitations", m.num_limitations)("limitations", m.limitations);
    json("last_error", m.last_error)("last_error_utime", m.last_error_utime);
}

void write_fields(Json &json, const rtc3d::output_status_t &m)
{
    json("name", m.name)("connected", m.connected)("problem", m.problem);
    json("num_messages", m.num_messages)("messages", m.messages)("num_drops", m.num_drops)("drops", m.drops);
    json("num_queries", m.num_queries)("queries", m.queries);
}

void write_fields(Json &json, const rtc3d::markers_t &m)
{
    write_header(json, m)("num_markers", m.num_markers)("markers", m.markers);
}

void write_fields(Json &json, const rtc3d::tools_t &m)
{
    write_header(json, m)("num_tools", m.num_tools)("tools", m.tools);
}

void write_fields(Json &json, const rtc3d::analog_t &m)
{
    write_header(json, m)("num_channels", m.num_channels)("voltages", m.voltages);
}

void write_fields(Json &json, const rtc3d::forces_t &m)
{
    write_header(json, m)("num_plates", m.num_plates)("plates", m.plates);
}

void write_fields(Json &json, const rtc3d::events_t &m)
{
    write_header(json, m)("num_events", m.num_events)("events", m.events);
}

void write_fields(Json &json, const rtc3d::tool_pose_t &m)
{
    write_header(json, m)("visible", m.visible)("position_m", m.position_m);
    json("orientation_xyzw", m.orientation_xyzw)("error_m", m.error_m);
}

void write_fields(Json &json, const rtc3d::status_t &m)
{
    write_prefix(json, m)("source", m.source)("server", m.server)("gateway_version", m.gateway_version);
    json("host", m.host)("frame_id", m.frame_id)("metres_per_unit", m.metres_per_unit);
    json("rotation_xyzw", m.rotation_xyzw)("translation_m", m.translation_m);
    json("num_streams", m.num_streams)("streams", m.streams)("num_outputs", m.num_outputs)("outputs", m.outputs);
}

void write_fields(Json &json, const rtc3d::clock_t &m)
{
    write_prefix(json, m)("components", m.components)("clock", m.clock);
}

void write_fields(Json &json, const rtc3d::parameters_t &m) { write_prefix(json, m)("xml", m.xml); }

void write_fields(Json &json, const rtc3d::parameters_request_t &m)
{
    json("request_id", m.request_id)("requester", m.requester);
    json("num_sections", m.num_sections)("sections", m.sections)("fresh", m.fresh);
}

void write_fields(Json &json, const rtc3d::parameters_reply_t &m)
{
    json("request_id", m.request_id)("requester", m.requester)("xml", m.xml);
    json("parameters_version", m.parameters_version)("age_s", m.age_s)("error", m.error);
    json("error_code", m.error_code);
}

void write_fields(Json &json, const rtc3d::command_request_t &m)
{
    json("request_id", m.request_id)("requester", m.requester)("command", m.command);
    json("num_options", m.num_options)("options", m.options);
}

void write_fields(Json &json, const rtc3d::command_reply_t &m)
{
    json("request_id", m.request_id)("requester", m.requester)("content", m.content);
    json("error", m.error)("error_code", m.error_code);
}

void write_fields(Json &json, const rtc3d::take_t &m)
{
    json("utime", m.utime)("name", m.name)("source", m.source)("channels", m.channels)("server", m.server);
    json("gateway_version", m.gateway_version)("recorder", m.recorder)("host", m.host);
}

void write_fields(Json &json, const rtc3d::take_details_t &m)
{
    json("utime", m.utime)("source", m.source)("subject", m.subject)("session", m.session)("note", m.note);
}

void write_fields(Json &json, const rtc3d::take_end_t &m)
{
    json("utime", m.utime)("source", m.source)("messages_lost", m.messages_lost);
}

// Return the message as JSON; nothing if `name` is none of these types, or if `data` is not a whole message.
template <class... Messages> std::string to_json(const std::string &name, const std::string &data)
{
    Json json;
    const auto try_type = [&](auto type) {
        using Message = typename decltype(type)::type;
        if (name != Message::getTypeName())
            return;
        if (const auto message = decode<Message>(data.data(), data.size()))
            json.write(*message);
    };
    try {
        (try_type(std::common_type<Messages>{}), ...);
    } catch (const std::invalid_argument &) { // a text that is not UTF-8
        return {};
    }
    return json.out.str();
}

std::optional<std::string> decode_hex(const std::string &digits)
{
    if (digits.size() % 2 != 0 || digits.find_first_not_of("0123456789abcdefABCDEF") != std::string::npos)
        return {};
    std::string data;
    for (std::size_t i = 0; i < digits.size(); i += 2)
        data += static_cast<char>(std::stoi(digits.substr(i, 2), nullptr, 16));
    return data;
}

// Read lines TYPE HEX.
int print_vectors()
{
    std::setlocale(LC_CTYPE, "C.UTF-8"); // the gateway's texts are UTF-8
    // What a damaged message claims to have must not fill the computer's memory.
    const rlimit quarter_gigabyte{1 << 28, 1 << 28};
    setrlimit(RLIMIT_AS, &quarter_gigabyte);
    for (std::string line; std::getline(std::cin, line);) {
        std::istringstream words(line);
        std::string name, digits;
        words >> name >> digits;
        const auto data = decode_hex(digits);
        if (!data) {
            std::cout << "{\"error\": \"this is not hexadecimal\"}\n";
            continue;
        }
        const std::string json =
            to_json<rtc3d::markers_t, rtc3d::tools_t, rtc3d::analog_t, rtc3d::forces_t, rtc3d::events_t,
                    rtc3d::tool_pose_t, rtc3d::status_t, rtc3d::clock_t, rtc3d::parameters_t,
                    rtc3d::parameters_request_t, rtc3d::parameters_reply_t, rtc3d::command_request_t,
                    rtc3d::command_reply_t, rtc3d::take_t, rtc3d::take_details_t,
                    rtc3d::take_end_t>(name, *data);
        if (json.empty())
            std::cout << "{\"error\": \"" << data->size() << " bytes are not a whole message of this type\"}\n";
        else
            std::cout << json << "\n";
    }
    return 0;
}

int main(int argc, char **argv)
{
    const std::vector<std::string> arguments(argv + 1, argv + argc);
    if (!arguments.empty() && arguments[0] == "--vectors")
        return print_vectors();
    if (!arguments.empty() && arguments[0][0] == '-') {
        std::cout << "Print the markers that a gateway publishes on LCM.\n"
                  << "Usage: " << argv[0] << " [SOURCE [COUNT]]\n"
                  << "       " << argv[0] << " --vectors < LINES\n";
        return arguments[0] == "--help" ? 0 : 2;
    }
    char *end = nullptr;
    const long count = arguments.size() > 1 ? std::strtol(arguments[1].c_str(), &end, 10) : 0;
    if (count < 0 || (end && *end)) {
        std::cerr << "COUNT must be a number, not " << arguments[1] << "\n";
        return 1;
    }
    return subscribe(arguments.empty() ? "LAB" : arguments[0], count);
}
