// Join the markers and the analog channels of one source, which have different rates, by their time stamps.
//
//   make -C examples cpp && examples/build/join [SOURCE [COUNT]]     for example: join LAB 100
//
// Building needs a C++17 compiler, make, and the Python package lcm, which has LCM's library and lcm-gen. SOURCE is the
// name of the source in upper case. For each frame of markers, the program prints the analog samples that were taken
// since the frame before, and it stops after COUNT frames. docs/how-to/join-components.md explains why it uses
// `timestamp`, not `frame_number`.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <deque>
#include <functional>
#include <iostream>
#include <lcm/lcm-cpp.hpp>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "rtc3d/analog_t.hpp"
#include "rtc3d/markers_t.hpp"

// Pairs each frame of markers with the analog samples since the frame before.
//
// The two arrive on connections of their own, and either can be ahead. A frame of markers therefore waits until an
// analog sample of the same time or a later one has arrived. Neither waits without a limit: if one component stops, the
// other does not fill the memory.
class Join
{
public:
    using Handler = std::function<void(const rtc3d::markers_t &, const std::vector<rtc3d::analog_t> &)>;

    explicit Join(Handler on_pair) : on_pair(std::move(on_pair)) {}

    void add(rtc3d::markers_t frame)
    {
        if (newest_frame && frame.timestamp < *newest_frame)
            start_again();
        newest_frame = frame.timestamp;
        frames.push_back(std::move(frame));
        pair();
    }

    void add(rtc3d::analog_t sample)
    {
        if (newest_sample && sample.timestamp < *newest_sample)
            start_again();
        newest_sample = sample.timestamp;
        samples.push_back(std::move(sample));
        pair();
        if (samples.size() > max_samples)
            samples.pop_front();
    }

private:
    static constexpr std::size_t max_frames = 1000;   // that wait for analog samples: 5 s at 200 Hz
    static constexpr std::size_t max_samples = 20000; // that wait for a frame of markers: 10 s at 2000 Hz

    Handler on_pair;
    std::deque<rtc3d::markers_t> frames;
    std::deque<rtc3d::analog_t> samples;
    std::optional<int64_t> newest_frame, newest_sample, previous_frame; // time stamps in us

    // Forget everything, because the time stamps have started again.
    void start_again()
    {
        frames.clear();
        samples.clear();
        newest_frame = newest_sample = previous_frame = std::nullopt;
    }

    void pair()
    {
        while (!frames.empty() && is_complete(frames.front())) {
            const rtc3d::markers_t frame = std::move(frames.front());
            frames.pop_front();
            std::vector<rtc3d::analog_t> since_previous;
            while (!samples.empty() && samples.front().timestamp <= frame.timestamp) {
                if (previous_frame && samples.front().timestamp > *previous_frame)
                    since_previous.push_back(std::move(samples.front()));
                samples.pop_front();
            }
            if (previous_frame)
                on_pair(frame, since_previous);
            previous_frame = frame.timestamp;
        }
    }

    bool is_complete(const rtc3d::markers_t &frame) const
    {
        return (newest_sample && *newest_sample >= frame.timestamp) || frames.size() > max_frames;
    }
};

void print_pair(const rtc3d::markers_t &frame, const std::vector<rtc3d::analog_t> &samples)
{
    const auto in_view = std::count_if(frame.markers.begin(), frame.markers.end(),
                                       [](const rtc3d::marker_t &marker) { return !std::isnan(marker.x); });
    std::printf("at %.4f s: %d markers in view (frame %d)", frame.timestamp / 1e6, static_cast<int>(in_view),
                frame.frame_number);
    if (!samples.empty()) {
        double sum = 0;
        for (const auto &sample : samples)
            sum += sample.voltages.empty() ? NAN : sample.voltages[0];
        std::printf(", %zu analog samples (frames %d to %d), mean of channel 1: %.3f", samples.size(),
                    samples.front().frame_number, samples.back().frame_number, sum / samples.size());
    }
    std::printf("\n");
    std::fflush(stdout);
}

// Passes the messages of one channel to a Join.
template <class Message> class Receiver
{
public:
    Receiver(Join &join, std::size_t item_bytes) : join(join), item_bytes(item_bytes) {}

    void on_message(const lcm::ReceiveBuffer *buffer, const std::string &channel)
    {
        Message message;
        const int size = static_cast<int>(buffer->data_size);
        if (!is_whole(buffer) || message.decode(buffer->data, 0, size) != size) {
            std::cerr << "ignored a malformed message on " << channel << "\n";
            return;
        }
        join.add(std::move(message));
    }

private:
    Join &join;
    std::size_t item_bytes;

    // The functions of lcm-gen allocate memory for the items before they look whether there are as many.
    bool is_whole(const lcm::ReceiveBuffer *buffer) const
    {
        const auto *count = static_cast<const unsigned char *>(buffer->data) + 52;
        if (buffer->data_size < 56)
            return false;
        const std::size_t items = std::size_t{count[0]} << 24 | count[1] << 16 | count[2] << 8 | count[3];
        return items * item_bytes == buffer->data_size - 56;
    }
};

int main(int argc, char **argv)
{
    const std::vector<std::string> arguments(argv + 1, argv + argc);
    if (!arguments.empty() && arguments[0][0] == '-') {
        std::cout << "Join markers and analog channels by their time stamps.\n"
                  << "Usage: " << argv[0] << " [SOURCE [COUNT]]\n";
        return arguments[0] == "--help" ? 0 : 2;
    }
    const std::string source = arguments.empty() ? "LAB" : arguments[0];
    char *end = nullptr;
    const long count = arguments.size() > 1 ? std::strtol(arguments[1].c_str(), &end, 10) : 0;
    if (count < 0 || (end && *end)) {
        std::cerr << "COUNT must be a number, not " << arguments[1] << "\n";
        return 1;
    }

    lcm::LCM lcm;
    if (!lcm.good()) {
        std::cerr << "Cannot open LCM; check $LCM_DEFAULT_URL and the multicast route\n";
        return 1;
    }
    long num_shown = 0;
    Join join([&](const auto &frame, const auto &samples) {
        if (count == 0 || num_shown < count)
            print_pair(frame, samples);
        num_shown++;
    });
    Receiver<rtc3d::markers_t> markers(join, 16);
    Receiver<rtc3d::analog_t> analog(join, 4);
    // The default of 30 messages loses frames whenever this program pauses.
    lcm.subscribe("MOCAP_" + source + "_3D", &Receiver<rtc3d::markers_t>::on_message, &markers)->setQueueCapacity(1000);
    lcm.subscribe("MOCAP_" + source + "_ANALOG", &Receiver<rtc3d::analog_t>::on_message, &analog)
        ->setQueueCapacity(10000);
    std::cout << "listening" << std::endl;
    while ((count == 0 || num_shown < count) && lcm.handle() == 0) {
    }
    return 0;
}
